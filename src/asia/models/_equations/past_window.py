"""Range of the states, and map from a past window to the state, both learned in training."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.models._data.cuts import rows
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, WindowPrior
from asia.models._equations.starts import RecordPieces


def window_prior(
    structure: GreyBoxStructure,
    segments: RecordPieces,
    scales: Scales,
    x: Array,
    y_deviation: Array,
) -> WindowPrior:
    """Ridge regression of the simulated state, `n_fit` samples before the first simulated one, on
    the past window's samples."""
    n_past, inside = structure.n_past, segments.mask > 0
    width = 1 + structure.n_past_u * structure.nu + structure.n_past_y * structure.ny
    y_center = segments.y[inside].mean(axis=0)
    spread = np.maximum(x[inside].std(axis=0), 1e-6 * scales.x_scale)
    prior = WindowPrior(np.zeros((structure.nx, width)), spread, y_center, y_deviation)
    windows = [
        _windows(structure, u[live], y[live], states[live])
        for u, y, states, live in zip(segments.u, segments.y, x, inside, strict=True)
        if live.sum() > n_past
    ]
    mean = x[inside].mean(axis=0)
    if not windows:
        return prior._replace(mean=np.hstack([mean[:, None], prior.mean[:, 1:]]))
    past_u, past_y, start = (np.concatenate(part) for part in zip(*windows, strict=True))
    phi = np.column_stack(
        [
            np.ones(len(start)),
            ((past_u - scales.u_center) / scales.u_scale).reshape(len(start), -1),
            ((past_y - y_center) / scales.y_scale).reshape(len(start), -1),
        ]
    )
    target = start - mean
    normal = phi.T @ phi + np.eye(width)
    weights = np.linalg.solve(normal, phi.T @ target).T
    error = np.sqrt(((target - phi @ weights.T) ** 2).mean(axis=0))
    weights[:, 0] += mean
    return prior._replace(mean=weights, x_deviation=np.maximum(error, 1e-3 * spread))


def _windows(
    structure: GreyBoxStructure, u: Array, y: Array, x: Array
) -> tuple[Array, Array, Array]:
    """Cut every past window of one record: past_u (W, n_past_u, nu), past_y (W, n_past_y, ny), and
    the state `n_fit` samples before its end (W, nx)."""
    n_past = structure.n_past
    first = np.arange(len(u) - n_past)

    def cut(values: Array, length: int) -> Array:
        return values[rows(first + n_past - length, length)]

    return (
        cut(u, structure.n_past_u),
        cut(y, structure.n_past_y),
        x[first + n_past - structure.n_fit],
    )
