"""Grey-boxes under slow disturbances of the output."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models import greybox, hybrid
from asia.models._least_squares import LevenbergMarquardt
from tests.unit.models.noise.drawn import slow_disturbance
from tests.unit.models.systems.equations import (
    DUFFING,
    DUFFING_TRUTH,
    context_for,
    duffing_record,
)

DT = 0.15
CONTEXT = context_for(DUFFING, "force", "y", DT, seed=3)
PLAIN = LevenbergMarquardt(iterations=30, starts=2)
SLOW = replace(PLAIN, noise_model="slow")


def disturbed(seed: int, time: float, slow: float, white: float) -> Trajectory:
    """A record with a slow disturbance and white noise on its output."""
    record, rng = duffing_record(250, seed), np.random.default_rng(seed + 50)
    drift = slow * slow_disturbance(len(record), float(np.exp(-DT / time)), rng)
    noise = drift + white * rng.standard_normal(len(record))
    return replace(record, y=record.y + noise[:, None])


def trained(record: Trajectory, method: LevenbergMarquardt) -> greybox.GreyBox:
    model = greybox.build(greybox.Config(), CONTEXT)
    return greybox.train(model, [record], CONTEXT, method)


def parameter_error(model: greybox.GreyBox) -> float:
    """Root mean square of the relative errors."""
    found = model.parameters()
    errors = [found[name] / value - 1.0 for name, value in DUFFING_TRUTH.items()]
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.slow
def test_generalised_least_squares_finds_the_parameters_under_a_slow_disturbance() -> None:
    ratios: list[float] = []
    for seed in (0, 1, 2):
        record = disturbed(seed, time=30.0, slow=0.5, white=0.02)
        plain, slow = (parameter_error(trained(record, m)) for m in (PLAIN, SLOW))
        ratios.append(slow / plain)
    assert np.median(ratios) < 0.5


def test_under_white_noise_the_fit_is_the_same() -> None:
    record = disturbed(3, time=3.0, slow=0.0, white=0.05)
    plain, slow = (trained(record, m).parameters() for m in (PLAIN, SLOW))
    for name, value in plain.items():
        assert slow[name] == pytest.approx(value, rel=1e-3)


def test_outliers_count_less_with_a_threshold_on_innovations() -> None:
    record = disturbed(4, time=3.0, slow=0.0, white=0.02)
    y = record.y.copy()
    y[5::25] += 1.5
    spoiled = replace(record, y=y)
    plain, robust = (
        parameter_error(trained(spoiled, m)) for m in (PLAIN, replace(PLAIN, huber=2.0))
    )
    assert robust < 0.5 * plain


@pytest.mark.long
def test_a_hybrid_and_windows_are_fitted_under_the_noise_model() -> None:
    record = disturbed(5, time=3.0, slow=0.1, white=0.02)
    for context in (CONTEXT, replace(CONTEXT, horizon=40)):
        model = hybrid.build(hybrid.Config(units=2), context)
        method = replace(SLOW, iterations=5)
        model = hybrid.train(model, [record], context, method)
        y: Array = model.simulate(record.u[None, :5], record.y[None, :5], record.u[None, 5:])
        assert np.sqrt(np.mean((y[0] - record.y[5:]) ** 2)) < 0.5 * record.y.std()


def test_two_robust_losses_are_refused() -> None:
    model = greybox.build(greybox.Config(robust=0.1), CONTEXT)
    with pytest.raises(UserError, match="leave robust out"):
        greybox.train(model, [disturbed(6, 3.0, 0.1, 0.02)], CONTEXT, SLOW)
