"""Simulation of cases: where a trained grey-box starts, and what follows. NumPy or JAX."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior, simulate
from asia.models._least_squares import (
    LevenbergMarquardt,
    NormalEquations,
    minimise,
    traced_minimum,
)

_METHOD = LevenbergMarquardt(iterations=12, damping=1e-3, tolerance=1e-10)
# Differences of fourth order, in units of the initial state's deviation.
_STEP = 1e-3
_WEIGHTS = {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}


def simulate_cases(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: Array,
    cases: tuple[Array, Array, Array],
) -> Array:
    """Outputs (B, H, ny) of cases past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu)
    with coordinates z (size,)."""
    past_u, past_y, u = cases
    scales, z = scales.for_rows(), z[:, None]
    with np.errstate(all="ignore"):
        x0, before = case_start(structure, scales, prior, z, past_u, past_y, u[:, 0])
        inputs = np.concatenate([before, u.transpose(1, 2, 0)])
        y, _ = simulate(structure, scales, z, x0[:, None], inputs)
    return y[structure.n_fit :, :, 0].transpose(2, 0, 1)


def case_start(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: AnyArray,
    past_u: AnyArray,
    past_y: AnyArray,
    u: AnyArray,
) -> tuple[AnyArray, AnyArray]:
    """States (nx, B) `n_fit` samples before the first simulated one, and the inputs (n_fit, nu, B)
    from there on, given z (size, 1) and the first simulated input u (B, nu), which is held back
    where the past window has too few inputs."""
    xp, n_fit = namespace(past_u, past_y, u), structure.n_fit
    before = past_u[:, -1:] if structure.measured else past_u
    held_back = xp.repeat(u[:, None], n_fit - before.shape[1], axis=1)
    inputs = xp.concatenate([held_back, before], axis=1).transpose(1, 2, 0)
    if structure.measured:
        order = np.array([structure.measured_states[i] for i in range(structure.nx)])
        return past_y[:, -1][:, order].T, inputs
    return _estimated(structure, scales, prior, z, past_u, past_y, inputs), inputs


def _estimated(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: AnyArray,
    past_u: AnyArray,
    past_y: AnyArray,
    inputs: AnyArray,
) -> AnyArray:
    """States (nx, B) `n_fit` samples before the first simulated one: the most probable ones given
    the outputs from there on, weighted by the model's simulation error, and the prior from
    training, which has seen the whole past window."""
    xp, count = namespace(past_u, past_y, inputs), len(past_y)
    features = (
        np.ones((count, 1)),
        ((past_u - scales.u_center[:, 0]) / scales.u_scale[:, 0]).reshape(count, -1),
        ((past_y - prior.y_center) / scales.y_scale[:, 0]).reshape(count, -1),
    )
    expected = np.asarray(prior.mean) @ xp.concatenate(features, axis=1).T
    if not structure.n_past_y:
        return expected
    nx, n_fit = structure.nx, structure.n_fit
    recent = past_y[:, max(structure.n_past_y - n_fit, 0) :].transpose(1, 2, 0)[:, :, None]
    deviation = np.asarray(prior.x_deviation)
    ways = np.concatenate([np.zeros((1, nx)), *(way * _STEP * np.eye(nx) for way in _WEIGHTS)])
    weights = np.array(list(_WEIGHTS.values())) / (12.0 * _STEP)

    def errors(shift: AnyArray) -> AnyArray:
        """(B, K, E) at shifts (B, K, nx) of the expected state, in deviations."""
        x0 = expected[:, None] + deviation[:, None, None] * shift.transpose(2, 1, 0)
        y, _ = simulate(structure, scales, z, x0, inputs)
        found = (y[n_fit - len(recent) :] - recent) / prior.y_deviation[:, None, None]
        return found.reshape(-1, *found.shape[2:]).transpose(2, 1, 0)

    def cost(shift: AnyArray) -> AnyArray:
        return (errors(shift) ** 2).sum(axis=-1) + (shift**2).sum(axis=-1)

    def linearise(shift: AnyArray) -> NormalEquations:
        found = errors(shift[:, None] + ways)
        error, around = found[:, 0], found[:, 1:].reshape(count, len(weights), nx, -1)
        slope = (weights[:, None, None] * around).sum(axis=1)
        return NormalEquations(
            (error**2).sum(axis=1) + (shift**2).sum(axis=1),
            slope @ slope.swapaxes(1, 2) + np.eye(nx),
            (slope @ error[..., None])[..., 0] + shift,
        )

    start = xp.zeros((count, nx))
    if xp is np:
        shift = minimise(cost, linearise, start, _METHOD).theta
    else:
        shift = traced_minimum(cost, linearise, start, _METHOD)
    return expected + deviation[:, None] * shift.T
