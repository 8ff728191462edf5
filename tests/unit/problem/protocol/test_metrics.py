"""Metrics that installed packages add, by name, beside the built-in ones."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from asia.errors import UserError
from asia.judge.scoring.outcome import score_fold, score_test
from asia.problem.metrics import METRICS, Metric, find_metric, metric_label, metric_names
from tests.unit import made_up_parts

MODULE = """
import numpy as np
from asia.problem.metrics import Metric

mae95 = Metric("mae95", "MAE 95", lambda y, y_hat: np.quantile(np.abs(y - y_hat), 0.95, axis=0))
other = "no metric"
"""


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[None]:
    """A package that brings the metric `mae95`, and one by a name that is not a metric."""
    points = "[asia.metrics]\nmae95 = made_up_metrics:mae95\nwrong = made_up_metrics:other\n"
    with made_up_parts.installed(tmp_path, "made_up_metrics", MODULE, points):
        yield


@pytest.mark.usefixtures("installed")
def test_a_metric_of_a_package_scores_folds_and_tests() -> None:
    assert metric_names() == (*METRICS, "mae95", "wrong")
    y, scale = np.zeros((200, 2)), np.array([2.0, 4.0])
    y_hat = np.linspace(0.0, 1.0, 200)[:, None] * np.array([1.0, 2.0])
    fold = score_fold([y], [y_hat], scale, "mae95")
    assert fold.value == pytest.approx(0.95 / 2)
    assert fold.per_channel("mae95") == fold.other == pytest.approx((0.95, 1.9))
    assert score_test([y], [y_hat], "mae95").value == pytest.approx((0.95 + 1.9) / 2)
    assert metric_label("mae95") == "MAE 95"


@pytest.mark.usefixtures("installed")
def test_a_part_that_is_no_metric_is_named() -> None:
    with pytest.raises(UserError, match=r"made_up_metrics:other of package made-up-metrics 1\.0"):
        find_metric("wrong")


def test_an_unknown_metric_names_the_known_ones() -> None:
    with pytest.raises(UserError, match="no metric 'rsme'; did you mean 'rmse'"):
        find_metric("rsme")
    assert metric_label("mae95") == "mae95"
    assert metric_label("mee") == "MEE"


def test_where_higher_is_better_v_is_the_distance_from_the_best() -> None:
    metric = Metric(
        "agreement", "agreement", lambda y, y_hat: 1.0 - np.abs(y - y_hat).mean(axis=0),
        unit="", direction="higher", best=1.0,
    )  # fmt: skip
    y = np.zeros((10, 2))
    near, far = (metric.shortfall(y, y + error, np.full(2, 5.0)) for error in (0.1, 0.3))
    assert (near, far) == (pytest.approx(0.1), pytest.approx(0.3))
    assert metric.v_label == "1 - agreement"


def test_a_metric_that_pools_the_outputs_is_refused() -> None:
    metric = Metric("pooled", "pooled", lambda y, y_hat: np.abs(y - y_hat).mean())
    with pytest.raises(UserError, match=r"shape \(\), expected \(2,\)"):
        metric.values(np.zeros((10, 2)), np.ones((10, 2)))
