"""Two filters and a static function: costs, derivatives, and the same model in state space."""

from __future__ import annotations

import numpy as np
import pytest

from asia.data import Array
from asia.models._numerics.training_records import ScaledTrajectory
from asia.models._state_space import wiener_hammerstein
from asia.models._state_space.wiener_hammerstein import (
    FilterEquations,
    FilterRidge,
    TwoFilters,
)


def model(records: int = 2) -> TwoFilters:
    rng = np.random.default_rng(0)
    return TwoFilters(
        np.array([0.0, 0.3, 0.2]),
        np.array([-1.2, 0.5]),
        np.array([1.0, 2.0, 1.5]),
        np.array([-1.0, 0.0, 1.0]),
        rng.standard_normal(3),
        np.array([0.1, 0.3, 0.2, 0.4]),
        np.array([-0.5, 0.2, 0.1]),
        np.array([0.1]),
        rng.standard_normal((records, 5)),
    )


def record(length: int, seed: int) -> ScaledTrajectory:
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal((2, length, 1))
    return ScaledTrajectory(u, y, rng.uniform(0.5, 1.5, (length, 1)), u, np.ones((length, 1)))


def gradient(equations: FilterEquations, theta: Array) -> Array:
    """Gradient by differences."""
    steps = 1e-6 * np.eye(len(theta))
    points = np.stack([theta + steps, theta - steps]).reshape(1, -1, len(theta))
    up, down = equations.costs(points)[0].reshape(2, -1)
    return (up - down) / 4e-6


def test_derivatives_over_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wiener_hammerstein, "_CHUNK", 100)
    p = model()
    theta = p.packed()
    pull = p.pull(FilterRidge(1e-3, 1e-2, 1e-1))
    equations = FilterEquations(p, [record(250, 1), record(120, 2)], pull, 0.9 * theta)
    found = equations.normal(theta[None])
    assert found.cost[0] == pytest.approx(equations.costs(theta[None, None])[0, 0], rel=1e-12)
    assert found.gradient[0] == pytest.approx(gradient(equations, theta), abs=1e-7)


def test_chunks_sum_to_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    p = model(1)
    theta = p.packed()
    equations = FilterEquations(p, [record(400, 3)], np.zeros(len(theta)), theta)
    whole = equations.normal(theta[None])
    monkeypatch.setattr(wiener_hammerstein, "_CHUNK", 150)
    parts = equations.normal(theta[None])
    assert parts.gram == pytest.approx(whole.gram, rel=1e-6, abs=1e-12)


def test_same_simulation_in_state_space() -> None:
    p, one = model(), record(200, 4)
    structure, params = p.state_space()
    assert (structure.order, structure.first, structure.hidden) == (5, 2, 3)
    y = structure.simulate(params, p.x0[1:], one.u[None])[1][0, :, 0]
    assert y == pytest.approx(wiener_hammerstein.simulated(p, one.u[:, 0], 1), abs=1e-12)


def test_static_first_filter() -> None:
    p = model(1)._replace(numerator1=np.array([0.7]), denominator1=np.zeros(0))
    p = p._replace(x0=p.x0[:, 2:])
    theta = p.packed()
    equations = FilterEquations(p, [record(150, 5)], np.zeros(len(theta)), theta)
    found = equations.normal(theta[None])
    assert found.gradient[0] == pytest.approx(gradient(equations, theta), abs=1e-7)
