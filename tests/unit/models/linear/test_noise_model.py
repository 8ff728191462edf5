"""Linear models under slow disturbances of the output."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.response import DrivenRecords
from asia.models._linear.system import LinearSystem
from asia.models._noise.model import ErrorWeighting, ResidualNoise
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import scaled
from tests.unit.models.noise.drawn import slow_disturbance

POLE, GAIN, SAMPLES = 0.95, 0.05, 800
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=5, n_past_y=5)
PLAIN = LevenbergMarquardt(30)


def record(seed: int, slow: float) -> Trajectory:
    """A first-order lag, a slow disturbance and white noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(SAMPLES), np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        y[k] = POLE * y[k - 1] + GAIN * u[k - 1]
    noise = slow * slow_disturbance(SAMPLES, 0.995, rng) + 0.01 * rng.standard_normal(SAMPLES)
    return Trajectory(u[:, None], (y + noise)[:, None], 1.0)


def pole_error(method: LevenbergMarquardt, data: Trajectory) -> float:
    model = linear.build(linear.Config(order=1), CONTEXT)
    fitted = linear.train(model, [data], CONTEXT, method).fitted
    assert fitted is not None
    return abs(float(fitted.system.a[0, 0]) - POLE)


@pytest.mark.long
def test_generalised_least_squares_finds_the_pole_under_a_slow_disturbance() -> None:
    methods = PLAIN, replace(PLAIN, noise_model="slow")
    errors = [[pole_error(method, record(seed, 0.3)) for method in methods] for seed in range(5)]
    plain, slow = np.sqrt(np.mean(np.square(errors), axis=0))
    assert slow < 0.4 * plain


@pytest.mark.slow
def test_under_white_noise_the_fit_is_the_same() -> None:
    data = record(7, 0.0)
    assert pole_error(replace(PLAIN, noise_model="slow"), data) == pytest.approx(
        pole_error(PLAIN, data), abs=1e-4
    )


@pytest.mark.parametrize("huber", [None, 1.0])
def test_derivatives_of_innovations(huber: float | None) -> None:
    data = [record(1, 0.3)[:60], record(2, 0.3)[:45]]
    records = scaled(data, Scaling.of(data))
    noise = ResidualNoise(np.array([10.0]), np.array([0.5]), np.array([0.2]))
    weightings = [ErrorWeighting.of(noise, 1.0, r.weight[None], huber) for r in records]
    driven = DrivenRecords(records, weightings)
    a, b = np.array([[0.8, 0.1], [-0.2, 0.7]]), np.array([[0.5], [0.3]])
    system = LinearSystem(a, b, np.array([[1.0, -0.4]]), np.array([[0.2]]), np.array([0.1]))
    x0, move = np.array([[0.3, -0.2], [0.1, 0.4]]), 1e-6
    ((jacobian, _),) = driven.response(system, x0).derivatives(1)

    def residual(by_a: float, by_x0: float) -> np.ndarray:
        moved = replace(system, a=a + by_a * np.array([[0.0, 1.0], [0.0, 0.0]]))
        away = x0 + by_x0 * np.array([[0.0, 0.0], [1.0, 0.0]])
        ((_, found),) = driven.response(moved, away).derivatives(1)
        return found

    for column, way in ((1, (move, 0.0)), (-2, (0.0, move))):
        slope = (residual(*way) - residual(-way[0], -way[1])) / (2 * move)
        assert_allclose(jacobian[:, column], -slope, atol=1e-6)
