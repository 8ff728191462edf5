"""Simulation of cases: where a trained grey-box starts, and what follows. NumPy alone."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior, simulate
from asia.models._solvers.least_squares import LevenbergMarquardt
from asia.models._solvers.minimise import NormalEquations, minimise

METHOD = LevenbergMarquardt(iterations=12, damping=1e-3, tolerance=1e-10)
# Differences of fourth order, in units of the initial state's deviation.
STEP = 1e-3
WEIGHTS = {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}


def simulate_cases(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: Array,
    cases: tuple[Array, Array, Array],
) -> Array:
    """Outputs (B, H, ny) of cases past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu)
    with coordinates z (size,).

    Without past inputs the first future one is held back.
    """
    past_u, past_y, u = cases
    n_fit = structure.n_fit
    before = past_u[:, -1:] if structure.measured else past_u
    held_back = np.repeat(u[:, :1], n_fit - before.shape[1], axis=1)
    inputs = np.concatenate([held_back, before, u], axis=1).transpose(1, 2, 0)
    scales = scales.for_rows()
    with np.errstate(all="ignore"):
        if structure.measured:
            x0 = past_y[:, -1, [structure.measured_states[i] for i in range(structure.nx)]].T
        else:
            x0 = _estimated(structure, scales, prior, z[:, None], past_u, past_y, inputs)
        y, _ = simulate(structure, scales, z[:, None], x0[:, None], inputs)
    return y[n_fit:, :, 0].transpose(2, 0, 1)


def _estimated(
    structure: GreyBoxStructure,
    scales: Scales,
    prior: WindowPrior,
    z: Array,
    past_u: Array,
    past_y: Array,
    inputs: Array,
) -> Array:
    """States (nx, B) `n_fit` samples before the first simulated one: the most probable ones given
    the outputs from there on, weighted by the model's simulation error, and the prior from
    training, which has seen the whole past window."""
    expected = prior.mean @ _features(scales, prior, past_u, past_y)
    if not structure.n_past_y:
        return expected
    nx, n_fit = structure.nx, structure.n_fit
    recent = past_y[:, max(structure.n_past_y - n_fit, 0) :].transpose(1, 2, 0)[:, :, None]
    inputs, deviation = inputs[:n_fit], prior.x_deviation[:, None, None]

    def errors(shift: Array) -> Array:
        """(E, K, B) at shifts (B, K, nx) of the expected state, in deviations."""
        x0 = expected[:, None] + deviation * shift.transpose(2, 1, 0)
        y, _ = simulate(structure, scales, z, x0, inputs)
        found = (y[n_fit - len(recent) :] - recent) / prior.y_deviation[:, None, None]
        return found.reshape(-1, *found.shape[2:])

    def cost(shift: Array) -> Array:
        return (errors(shift) ** 2).sum(axis=0).T + (shift**2).sum(axis=-1)

    def linearise(shift: Array) -> NormalEquations:
        ways = [way * STEP * np.eye(nx) for way in WEIGHTS]
        found = errors(shift[:, None] + np.concatenate([np.zeros((1, nx)), *ways]))
        error, around = found[:, 0], found[:, 1:].reshape(len(found), len(ways), nx, -1)
        weights = np.array(list(WEIGHTS.values())) / (12.0 * STEP)
        jacobian = np.einsum("w,ewnb->ben", weights, around)
        turned = jacobian.transpose(0, 2, 1)
        return NormalEquations(
            (error**2).sum(axis=0) + (shift**2).sum(axis=1),
            turned @ jacobian + np.eye(nx),
            (turned @ error.T[..., None])[..., 0] + shift,
        )

    shift = minimise(cost, linearise, np.zeros((len(past_y), nx)), METHOD).theta
    return expected + prior.x_deviation[:, None] * shift.T


def _features(scales: Scales, prior: WindowPrior, past_u: Array, past_y: Array) -> Array:
    """1 and the normalised samples of each past window, (1 + n_past_u nu + n_past_y ny, B)."""
    count = len(past_y)
    parts = (
        np.ones((count, 1)),
        ((past_u - scales.u_center[:, 0]) / scales.u_scale[:, 0]).reshape(count, -1),
        ((past_y - prior.y_center) / scales.y_scale[:, 0]).reshape(count, -1),
    )
    return np.concatenate(parts, axis=1).T
