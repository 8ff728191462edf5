"""Normal equations of a fit against derivatives by JAX."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.models import greybox
from asia.models._equations.programs import CompiledSimulator
from asia.models._equations.simulate import Scales, simulate
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import Starts, cut_segments
from tests.unit.models.systems.equations import DUFFING, context_for, duffing_record

STARTS = 2
RECORDS = [duffing_record(60, 0, 0.01), duffing_record(45, 1, 0.01)]


def error_of(
    config: greybox.Config, horizon: int | None = None, *, forward: bool = False
) -> SimulationError:
    """Simulation error of two starts that are not at a minimum; the last coordinate is not
    fitted."""
    context = replace(context_for(DUFFING, "force", "y", 0.15), horizon=horizon)
    structure = greybox.build(config, context).structure
    segments = cut_segments(structure, RECORDS, horizon)
    rng = np.random.default_rng(0)
    units, nx, count = config.residual, structure.nx, len(segments.u)
    sizes = [rng.uniform(0.5, 1.5, (n, STARTS)) for n in (nx, nx, nx, nx, 1, 1)]
    sizes[2] = sizes[0] + 1.0
    scales = Scales(
        *sizes,
        y_scale=np.full((1, STARTS), 0.8),
        low=np.full((nx, STARTS), -1e3),
        high=np.full((nx, STARTS), 1e3),
        hidden=rng.normal(size=(units, nx + 2, STARTS)),
    )
    z = 0.3 * rng.normal(size=(STARTS, structure.layout.size))
    guess = rng.normal(size=(STARTS, count, nx))
    active = np.ones(structure.layout.size)
    active[-1] = 0.0
    simulator = CompiledSimulator(structure, segments.u, 3)
    shift = 0.1 * rng.normal(size=guess.shape)
    starts = Starts(z, shift, guess, scales)
    return SimulationError(structure, segments, starts, active, simulator, forward=forward)


def test_forward_differences_are_near_central_ones() -> None:
    config = greybox.Config(prior_width=1.0)
    exact, quick = (error_of(config, forward=forward) for forward in (False, True))
    one, other = (error.linearise(error.theta0) for error in (exact, quick))
    np.testing.assert_array_equal(one.cost, other.cost)
    size = np.sqrt(np.diagonal(one.gram, axis1=1, axis2=2)) + 1e-12
    apart = (other.gram - one.gram) / size[:, :, None] / size[:, None]
    assert 0.0 < np.abs(apart).max() < 1e-4
    apart = (other.gradient - one.gradient) / size / np.sqrt(one.cost)[:, None]
    assert 0.0 < np.abs(apart).max() < 1e-4


def residuals(error: Any, row: int) -> Callable[[jax.Array], jax.Array]:
    """All that is squared, of one start, by theta (n,)."""
    structure, segments, starts = error._structure, error._segments, error._starts
    scales = Scales(*(jnp.asarray(a[..., row : row + 1]) for a in starts.scales))
    size = structure.layout.size
    threshold = structure.config.robust
    weight = segments.mask / np.sqrt(segments.mask.sum() * structure.ny)

    def run(given: Any) -> jax.Array:
        theta = jnp.asarray(given)
        shift = theta[size:].reshape(-1, structure.nx)
        x0 = (starts.x_guess[row] + shift * scales.x_scale[:, 0]).T[:, None]
        u = jnp.asarray(segments.u.transpose(1, 2, 0))
        y, _ = simulate(structure, scales, theta[:size, None], x0, u)
        e = (y[:, :, 0].transpose(2, 0, 1) - segments.y) / scales.y_scale[:, 0]
        if threshold is not None:
            tail = jnp.sqrt(jnp.maximum(2 * threshold * jnp.abs(e) - threshold**2, 1e-12))
            e = jnp.where(jnp.abs(e) <= threshold, e, jnp.sign(e) * tail)
        layout, config = structure.layout, structure.config
        ridge = np.full(size, config.ridge)
        ridge[layout.hidden] = ridge[layout.readout] = config.residual_ridge
        for part in (layout.parameters, layout.limits, layout.spill):
            ridge[part] = 1e-6
        effect = theta[:size].at[layout.spill].set(jnp.exp(theta[layout.spill]))
        kept = np.sqrt(ridge) * error._active * effect
        e = e * weight[..., None]
        return jnp.concatenate([e.ravel(), kept, np.sqrt(1e-6 / len(shift)) * theta[size:]])

    return run


@pytest.mark.slow
@pytest.mark.parametrize("horizon", [None, 10])
@pytest.mark.parametrize(
    "config",
    [
        greybox.Config(),
        greybox.Config(saturation=("position",), spill=True, linear=True),
        greybox.Config(residual=2, robust=0.3, offset=("velocity", "y"), substeps=1),
    ],
)
def test_costs_and_normal_equations(config: greybox.Config, horizon: int | None) -> None:
    error = error_of(config, horizon)
    theta = error.theta0
    found = error.linearise(theta)
    points = np.stack([theta, theta + 0.01], axis=1)
    np.testing.assert_allclose(error.cost(points)[:, 0], found.cost, rtol=1e-12)
    with jax.enable_x64(True):
        for row in range(STARTS):
            e = jax.jit(residuals(error, row))
            jacobian = jax.jit(jax.jacfwd(residuals(error, row)))
            value, by = np.asarray(e(theta[row])), np.array(jacobian(theta[row]))
            by[:, : len(error._active)] *= error._active  # pyright: ignore[reportPrivateUsage]
            size = np.linalg.norm(by, axis=0) + 1e-12
            assert found.cost[row] == pytest.approx(value @ value, rel=1e-9)
            gram = (by.T @ by - found.gram[row]) / size / size[:, None]
            assert np.abs(gram).max() < 1e-6
            pull = (by.T @ value - found.gradient[row]) / size / np.linalg.norm(value)
            assert np.abs(pull).max() < 1e-6
            other = e(points[row, 1])
            assert error.cost(points)[row, 1] == pytest.approx(float(other @ other), rel=1e-9)


def test_rows_that_have_not_moved_keep_their_normal_equations() -> None:
    error, other = error_of(greybox.Config()), error_of(greybox.Config())
    theta = error.theta0.copy()
    error.linearise(theta)
    theta[1] += 0.01
    for found, expected in zip(error.linearise(theta), other.linearise(theta), strict=True):
        np.testing.assert_array_equal(found, expected)
    still = [values.copy() for values in error.linearise(theta)]
    for found, expected in zip(still, other.linearise(theta), strict=True):
        np.testing.assert_array_equal(found, expected)
