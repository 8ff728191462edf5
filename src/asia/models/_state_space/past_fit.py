"""Initial state of a state-space model, fitted to the past window.

The map from past windows to states errs by more than the sensor, and where small differences grow
that decides the simulation. So the state at the first sample of the window is taken from the map,
and moved until the model simulates the window: the state of greatest posterior probability, by
Gauss-Newton steps, with the errors of map and model on the training records as deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import ScaledData, past_length, window_rows, windows
from asia.models._state_space.structure import StateSpaceStructure

if TYPE_CHECKING:
    from asia.models._state_space.fit import StateFit

STEPS, DIFFERENCE = 8, 1e-5
# Least deviations, of a state relative to its spread and of an output in z-scores.
_LEAST_STATE, _LEAST_OUTPUT = 1e-3, 1e-4
DAMPING, LESS, MORE = 1e-3, 0.2, 10.0


@dataclass(frozen=True)
class PastFit:
    """How a state is fitted to the past window."""

    samples: int
    """Of the window, its last ones."""
    x_deviation: Array
    """(n,) of what the map from the past window says of the state before them."""
    y_deviation: Array
    """(ny,) of the model's output."""


def window_samples(context: Context) -> int:
    """Samples of the past window in which inputs and outputs are known."""
    return min(context.n_past_u, context.n_past_y)


def past_fit(
    structure: StateSpaceStructure,
    fit: StateFit,
    records: ScaledData,
    context: Context,
    hidden: int,
) -> tuple[Encoder, PastFit]:
    """Map from the past window to the state before its last samples, and how that is fitted."""
    skip, back = past_length(context), window_samples(context)
    features, states, errors = list[Array](), list[Array](), list[Array]()
    for record, x0, at in zip(records, fit.x0, window_rows(records, context), strict=True):
        if len(record) > skip:
            x, y = structure.simulate(fit.params, x0[None], record.u[None])
            features.append(windows(record, context)[at])
            states.append(x[0, skip - back : len(record) - back][at])
            errors.append((y[0] - record.y)[record.counts > 0])
    encoder = fit_encoder(features, states, hidden, context.seed)
    left = np.concatenate([encoder(f) - x for f, x in zip(features, states, strict=True)])
    spread = np.concatenate(states).std(axis=0)
    x_deviation = np.maximum(_rms(left), np.maximum(_LEAST_STATE * spread, 1e-9))
    y_deviation = np.maximum(_rms(np.concatenate(errors)), _LEAST_OUTPUT)
    return encoder, PastFit(back, x_deviation, y_deviation)


def _rms(values: Array) -> Array:
    return np.sqrt((values**2).mean(axis=0))


def fitted_state(
    structure: StateSpaceStructure,
    params: Mapping[str, Any],
    how: PastFit,
    guess: Array,
    u: Array,
    y: Array,
) -> Array:
    """guess (B, n) of the state at the first of `how.samples` samples, u (B, samples + 1, nu) and
    y (B, samples, ny), z-scored -> the state (B, n) after them. Each window for itself."""
    window = _Window(structure, params, how, guess, u, y)
    x, damping = guess, np.full(len(guess), DAMPING)
    with np.errstate(all="ignore"):
        residual, cost = window.residual(x)
        for _ in range(STEPS):
            moved = x + window.step(x, residual, damping)
            after, costs = window.residual(moved)
            better = costs < cost
            x = np.where(better[:, None], moved, x)
            residual = np.where(better[:, None], after, residual)
            cost = np.where(better, costs, cost)
            damping = np.where(better, damping * LESS, damping * MORE)
        return structure.simulate(params, x, u)[0][:, -1]


@dataclass(frozen=True)
class _Window:
    structure: StateSpaceStructure
    params: Mapping[str, Any]
    how: PastFit
    guess: Array
    u: Array
    y: Array

    def residual(self, x: Array) -> tuple[Array, Array]:
        """x (B, n) -> weighted residuals (B, samples ny + n) and their sums of squares (B,),
        infinite where the simulation diverges."""
        _, y = self.structure.simulate(self.params, x, self.u[:, :-1])
        error = ((y - self.y) / self.how.y_deviation).reshape(len(x), -1)
        both = np.concatenate([error, (x - self.guess) / self.how.x_deviation], axis=1)
        cost = (both**2).sum(axis=1)
        return both, np.where(np.isfinite(cost), cost, np.inf)

    def step(self, x: Array, residual: Array, damping: Array) -> Array:
        """Gauss-Newton steps (B, n), zero where one cannot be computed."""
        n = x.shape[1]
        width = DIFFERENCE * self.how.x_deviation
        columns = [
            (self.residual(x + np.eye(n)[j] * width[j])[0] - residual) / width[j] for j in range(n)
        ]
        slope = np.nan_to_num(np.stack(columns, axis=2), posinf=0.0, neginf=0.0)
        gram = np.einsum("bri,brj->bij", slope, slope)
        diagonal = np.einsum("bii->bi", gram)[:, :, None] * np.eye(n)
        gradient = np.einsum("bri,br->bi", slope, np.nan_to_num(residual, posinf=0.0, neginf=0.0))
        held = gram + damping[:, None, None] * diagonal + 1e-12 * np.eye(n)
        return -np.linalg.solve(held, gradient[:, :, None])[:, :, 0]
