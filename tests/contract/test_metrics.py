"""Every metric passes its suite, and the suite fails for those that break one of its rules."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from asia.judge.scoring.outcome import fit_index
from asia.problem.metrics import METRICS, Metric, find_metric, metric_names
from asia.testing import check_metric

FIT = Metric("fit", "fit index", fit_index, unit="%", direction="higher", best=100.0)
MAE = METRICS["mae"]


@pytest.mark.parametrize("name", metric_names())
def test_every_metric_of_the_table(name: str) -> None:
    check_metric(find_metric(name))


def test_a_metric_whose_values_are_better_when_higher() -> None:
    check_metric(FIT)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (replace(FIT, direction="lower", best=0.0), "another value than best"),
        (replace(FIT, best=1.0), "another value than best"),
        (replace(MAE, unit="%"), "measured in another unit"),
        (replace(FIT, unit="signal"), "measured in another unit"),
        (replace(MAE, loss="fit"), "loss is 'fit'"),
        (replace(MAE, function=lambda y, y_hat: 1e-3 * (y_hat - y).sum(axis=0) ** 0), "best"),
        (replace(MAE, function=lambda y, y_hat: np.abs(y - y_hat)[-1]), "order of trajectories"),
        (
            replace(MAE, function=lambda y, y_hat: np.full(y.shape[1], np.abs(y - y_hat).mean())),
            "depends on the others",
        ),
        (replace(MAE, function=lambda y, y_hat: 0.0 * np.abs(y - y_hat).mean(axis=0)), "large"),
    ],
)
def test_the_suite_finds(broken: Metric, message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_metric(broken)


def spoiling(measure: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    def spoil(y: np.ndarray, y_hat: np.ndarray) -> np.ndarray:
        y_hat -= y
        return measure(np.zeros_like(y), y_hat)

    return spoil


def test_the_suite_finds_a_metric_that_changes_its_arguments() -> None:
    with pytest.raises(AssertionError, match="were changed"):
        check_metric(replace(MAE, function=spoiling(MAE.function)))
