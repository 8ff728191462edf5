"""Neural state-space models fitted by Levenberg-Marquardt under slow disturbances."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import arx, narx, neural_ss
from asia.models._arrays import Packing, packed
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import ErrorWeighting, ResidualNoise
from asia.models._state_space import programs
from asia.models._state_space.structure import StateSpaceStructure
from tests.unit.models.noise.drawn import slow_disturbance

SAMPLES, PAST = 500, 4
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, n_past_u=PAST, n_past_y=PAST, seed=1)
METHOD = LevenbergMarquardt(25)


def error(method: LevenbergMarquardt, seed: int) -> float:
    """Simulation error against the truth, without its mean."""
    rng = np.random.default_rng(seed)
    u, truth = rng.standard_normal((2, SAMPLES)), np.zeros((2, SAMPLES))
    for k in range(1, SAMPLES):
        truth[:, k] = 0.9 * truth[:, k - 1] + 0.4 * np.tanh(1.5 * u[:, k - 1])
    noise = slow_disturbance(SAMPLES, 0.99, rng) + 0.02 * rng.standard_normal(SAMPLES)
    record = Trajectory(u[0][:, None], (truth[0] + noise)[:, None], 1.0)
    model = neural_ss.build(neural_ss.Config(order=1, hidden=4), CONTEXT)
    model = neural_ss.train(model, [record], CONTEXT, method)
    past = u[1][None, :PAST, None], truth[1][None, :PAST, None]
    y = model.simulate(*past, u[1][None, PAST:, None])[0, :, 0]
    return float(np.std((y - truth[1][PAST:])[50:]))


@pytest.mark.slow
def test_a_slow_disturbance_costs_less_with_its_model() -> None:
    slow = replace(METHOD, noise_model="slow")
    assert np.median([error(slow, seed) / error(METHOD, seed) for seed in range(3)]) < 0.5


@pytest.mark.parametrize(
    ("huber", "stability"), [(None, None), (0.7, programs.StabilityTerm(0.3, 4))]
)
def test_normal_equations_of_innovations(
    huber: float | None, stability: programs.StabilityTerm | None, monkeypatch: Any
) -> None:
    monkeypatch.setattr(programs, "_CHUNK_VALUES", 200)
    structure = StateSpaceStructure(2, 1, 2, "state", "tanh", 2, 3, None)
    rng = np.random.default_rng(0)
    u, y, weight = rng.normal(size=(2, 30, 1)), rng.normal(size=(2, 30, 2)), np.ones((2, 30, 2))
    weight[1, 22:], weight[0, 5:9, 1] = 0.0, 0.0
    samples = programs.StateSamples(rng.normal(size=(2, 2)), u, y, weight, known=False)
    tree: dict[str, Any] = {
        "a": np.array([[0.8, 0.1], [-0.1, 0.6]]),
        "b": rng.normal(size=(1, 2)),
        "c": rng.normal(size=(2, 2)),
        "d": rng.normal(size=(1, 2)),
        "offset": rng.normal(size=2),
        "x0": samples.x0,
    }
    noise = ResidualNoise(np.array([8.0, 3.0]), np.array([0.5, 0.4]), np.array([0.2, 0.3]))
    weighting = ErrorWeighting.of(noise, 1.0, weight, huber)
    theta, packing = packed(tree, np.float64), Packing.of(tree)
    none = np.zeros_like(theta)
    chunks = programs.chunked(samples, structure, none, theta, weighting)
    chunks = chunks._replace(stability=stability)
    assert len(chunks.u) > 1

    def residual(theta: np.ndarray) -> np.ndarray:
        p = packing.unpack(theta)
        found = weighting(structure.simulate(p, p["x0"], u)[1] - y)
        errors = (found * weight).ravel() / np.sqrt(weight.sum())
        if stability is None:
            return errors
        growth = np.sqrt(stability.weight) * np.linalg.matrix_power(p["a"], 16)
        return np.concatenate([errors, growth.ravel()])

    equations = programs.CompiledEquations(structure, packing, chunks, lambda *_: None)
    found = equations.normal(theta[None])
    step = 1e-6 * np.eye(len(theta))
    jacobian = np.stack([(residual(theta + s) - residual(theta - s)) / 2e-6 for s in step], axis=1)
    e = residual(theta)
    assert_allclose(found.cost[0], e @ e, rtol=1e-9)
    assert_allclose(found.gram[0], jacobian.T @ jacobian, atol=1e-5)
    assert_allclose(found.gradient[0], jacobian.T @ e, atol=1e-5)
    assert_allclose(equations.costs(theta[None, None])[0, 0], e @ e, rtol=1e-9)


@pytest.mark.parametrize("family", [arx, narx])
def test_families_that_predict_one_step_refuse(family: Any) -> None:
    model = family.build(family.Config(), CONTEXT)
    record = Trajectory(np.ones((50, 1)), np.ones((50, 1)), 1.0)
    with pytest.raises(UserError, match="cannot weigh errors by a noise model"):
        family.train(model, [record], CONTEXT, replace(METHOD, noise_model="slow"))
