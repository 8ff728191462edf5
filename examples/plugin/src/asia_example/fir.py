"""Finite impulse response: the output is a weighted sum of the last inputs, and a constant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from asia.candidate import Context
from asia.models.methods import LeastSquares
from asia.problem import Array, Trajectory

_RIDGE = 1e-3


@dataclass(frozen=True)
class Config:
    """The settings of the family."""

    taps: int = 40
    """How many of the last inputs count, that of the same sample among them."""

    def __post_init__(self) -> None:
        if self.taps < 1:
            raise ValueError(f"fir: taps is {self.taps}, expected at least 1")


@dataclass(frozen=True)
class Model:
    """A finite impulse response with an offset."""

    config: Config
    """The settings."""
    weights: Array
    """(nu * taps + 1, ny): of each input, the oldest tap first, then the offset."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """As `asia.candidate.Model`. Inputs before the past window equal its first sample."""
        del past_y
        known = np.concatenate([past_u, u], axis=1)
        return (
            np.stack([_regressors(row, self.config.taps) for row in known])[:, past_u.shape[1] :]
            @ self.weights
        )


def build(config: Config, context: Context) -> Model:
    """A model that answers zero."""
    return Model(config, np.zeros((context.nu * config.taps + 1, context.ny)))


def train(
    model: Model, trajectories: Sequence[Trajectory], context: Context, method: LeastSquares
) -> Model:
    """Ridge regression on all samples whose taps lie inside their record."""
    taps = model.config.taps
    usable = [t for t in trajectories if len(t) > taps]
    x = np.concatenate([_regressors(t.u, taps)[taps - 1 :] for t in usable])
    y = np.concatenate([t.y[taps - 1 :] for t in usable])
    scale = np.append(np.full(x.shape[1] - 1, x[:, :-1].std()), 1.0)
    ridge = (_RIDGE if method.ridge is None else method.ridge) * len(x)
    penalty = ridge * np.append(np.ones(x.shape[1] - 1), 0.0)
    x = x / scale
    weights = np.linalg.solve(x.T @ x + np.diag(penalty), x.T @ y) / scale[:, None]
    context.log(1, float(np.sqrt(np.mean((x * scale @ weights - y) ** 2))))
    return Model(model.config, weights)


def _regressors(u: Array, taps: int) -> Array:
    """(T, nu) -> (T, nu * taps + 1)."""
    padded = np.concatenate([np.repeat(u[:1], taps - 1, axis=0), u])
    lagged = sliding_window_view(padded, taps, axis=0).reshape(len(u), -1)
    return np.concatenate([lagged, np.ones((len(u), 1))], axis=1)
