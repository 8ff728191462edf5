"""Gains and time constants of a linear model with their standard errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt

CONTEXT = Context((Signal("u", "V"),), (Signal("y", "m"),), 0.5, 5, 5)
METHOD = LevenbergMarquardt(iterations=40, tolerance=1e-10)
GAIN, TIME = 0.5 / (1 - 0.9), -1 / np.log(0.9)


def records(seed: int, noise: float = 0.2) -> list[Trajectory]:
    rng = np.random.default_rng(seed)
    found: list[Trajectory] = []
    for _ in range(2):
        u = np.repeat(rng.normal(size=60), 5)
        y = lfilter([0.0, 0.5], [1.0, -0.9], u) + noise * rng.normal(size=300)
        found.append(Trajectory(u[:, None], y[:, None], 0.5, ""))
    return found


def fitted(data: list[Trajectory], **config: int) -> linear.LinearStateSpace:
    model = linear.build(linear.Config(**({"order": 1} | config)), CONTEXT)
    return linear.train(model, data, CONTEXT, METHOD)


@pytest.mark.slow
def test_gain_and_time_constant_lie_within_their_errors() -> None:
    held: list[bool] = []
    for seed in range(20):
        data = records(seed)
        model = fitted(data)
        gain, time = model.estimates(data, CONTEXT).parameters
        assert gain.name == "gain y1/u1"
        assert gain.unit == "m/V"
        assert {gain.name: gain.value}.items() <= model.parameters().items()
        held += [gain.low < GAIN < gain.high, time.low < TIME < time.high]
    assert np.mean(held) > 0.85


def test_they_do_not_depend_on_the_coordinates_of_the_states() -> None:
    """A change of the states that changes nothing else makes no error infinite."""
    data = records(1)
    model = fitted(data, order=2)
    first = model.estimates(data, CONTEXT)
    assert model.fitted is not None
    turned = model.fitted.system.transformed(np.array([[2.0, 0.3], [-0.5, 1.0]]))
    second = replace(model, fitted=replace(model.fitted, system=turned)).estimates(data, CONTEXT)
    for one, other in zip(first.parameters, second.parameters, strict=True):
        assert np.isfinite(one.standard_error)
        assert one.standard_error == pytest.approx(other.standard_error, rel=0.02)


def test_records_that_it_was_not_fitted_to_are_refused() -> None:
    model = fitted(records(1))
    with pytest.raises(ValueError, match="no minimum"):
        model.estimates(records(2, noise=1.0), CONTEXT)


def test_an_unmeasured_sample_leaves_the_errors_as_they_are() -> None:
    data = records(1)
    whole = fitted(data).estimates(data, CONTEXT).parameters
    y = data[0].y.copy()
    y[130] = np.nan
    gapped = [Trajectory(data[0].u, y, 0.5, ""), data[1]]
    found = fitted(gapped).estimates(gapped, CONTEXT).parameters
    for one, other in zip(found, whole, strict=True):
        assert one.standard_error == pytest.approx(other.standard_error, rel=0.05)
