"""Outputs that were not measured, as a model gives them."""

from __future__ import annotations

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models._numerics.gaps import reconstructed
from asia.models._numerics.lags import Lags, regressors
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled

CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, 2, 2)
PLAIN = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))


def echo(past_u: Array, past_y: Array, u: Array) -> Array:
    del past_u, past_y
    return u


def filled(error: Array, lost: slice) -> tuple[Trajectory, Array]:
    u = np.sin(np.arange(len(error)))[:, None]
    y = u + error[:, None]
    y[lost] = np.nan
    record = Trajectory(u, y, 1.0)
    (found,) = reconstructed(scaled([record], PLAIN), echo, CONTEXT)
    assert (found.y[record.measured] == record.y[record.measured]).all()
    return record, found.y[:, 0] - u[:, 0]


def test_a_model_with_white_errors_is_believed() -> None:
    error = np.resize([0.1, -0.1, -0.1, 0.1], 200) * np.random.default_rng(0).choice([-1, 1], 200)
    _, found = filled(error, slice(50, 60))
    assert np.abs(found[50:60]).max() < 0.03


def test_errors_that_last_are_bridged() -> None:
    _, found = filled(np.full(200, 0.3), slice(50, 60))
    assert found[50:60] == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize("lost", [slice(190, 200), slice(3, 12)])
def test_gaps_at_the_ends_are_filled(lost: slice) -> None:
    _, found = filled(np.full(200, 0.3), lost)
    assert np.isfinite(found).all()
    near = lost.start if lost.stop == 200 else lost.stop - 1
    assert found[near] == pytest.approx(0.3, abs=0.02)


def test_samples_with_filled_lags_are_learned_from_and_filled_ones_are_no_targets() -> None:
    record, _ = filled(np.zeros(40), slice(20, 25))
    plain = scaled([record], PLAIN)[0]
    (whole,) = reconstructed([plain], echo, CONTEXT)
    assert regressors(plain, Lags(3, 1))[2].sum() == 40 - 3 - 5 - 3
    assert regressors(whole, Lags(3, 1))[2].sum() == 40 - 3 - 5
