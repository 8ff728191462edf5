"""Fit of the initial state of a state-space model to the past window.

The map from past windows to states errs by more than the sensor, and where small differences grow
that error dominates the simulation. So the state at the first sample of the window is taken from
the map, and moved until the model simulates the window: the state of greatest posterior
probability, by Gauss-Newton steps, with the errors of map and model on the training records as
deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._data.encoder import Encoder, fit_encoder
from asia.models._data.records import ScaledData, past_length, window_rows, windows
from asia.models._least_squares import (
    DampingSchedule,
    LevenbergMarquardt,
    NormalEquations,
    minimise,
    traced_minimum,
)
from asia.models._state_space.structure import StateSpaceStructure

if TYPE_CHECKING:
    from asia.models._state_space.fit import StateFit

_DIFFERENCE = 1e-5
# Least deviations, of a state relative to its spread and of an output in z-scores.
_LEAST_STATE, _LEAST_OUTPUT = 1e-3, 1e-4
_METHOD = LevenbergMarquardt(iterations=8, damping=1e-3, tolerance=0.0)
_SCHEDULE = DampingSchedule((1.0,), 0.2, 10.0, 0.0, float("inf"), retries=False)


@dataclass(frozen=True)
class PastFit:
    """Settings of the fit of a state to the past window."""

    samples: int
    """Number of last samples of the window that are used."""
    x_deviation: Array
    """Deviation (n,) of the state that the map predicts before these samples."""
    y_deviation: Array
    """Deviation (ny,) of the model's output."""


def window_samples(context: Context) -> int:
    """Number of samples of the past window in which inputs and outputs are known."""
    return min(context.n_past_u, context.n_past_y)


def past_fit(
    structure: StateSpaceStructure,
    fit: StateFit,
    records: ScaledData,
    context: Context,
    hidden: int,
) -> tuple[Encoder, PastFit]:
    """Map from the past window to the state before its last samples, and settings of the fit to
    them."""
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
    guess: AnyArray,
    u: AnyArray,
    y: AnyArray,
) -> AnyArray:
    """Fit the state of each window separately; NumPy or JAX.

    Args:
        structure: equations of the model.
        params: parameters.
        how: settings.
        guess: guess (B, n) of the state at the first of `how.samples` samples.
        u: z-scored inputs (B, samples + 1, nu).
        y: z-scored outputs (B, samples, ny).

    Returns:
        The state (B, n) after the samples.
    """
    xp, (batch, n) = namespace(guess, u, y), guess.shape
    ways = _DIFFERENCE * np.concatenate([np.zeros((1, n)), np.diag(how.x_deviation)])

    def residuals(x: AnyArray) -> AnyArray:
        """Weighted residuals (B, K, samples ny + n) at states (B, K, n)."""
        points = x.shape[1]
        held, measured = xp.repeat(u[:, :-1], points, axis=0), xp.repeat(y, points, axis=0)
        found = structure.simulate(params, x.reshape(batch * points, n), held)[1]
        error = ((found - measured) / how.y_deviation).reshape(batch, points, -1)
        return xp.concatenate([error, (x - guess[:, None]) / how.x_deviation], axis=2)

    def cost(x: AnyArray) -> AnyArray:
        return (residuals(x) ** 2).sum(axis=2)

    def linearise(x: AnyArray) -> NormalEquations:
        found = residuals(x[:, None] + ways)
        slope = (found[:, 1:] - found[:, :1]) / (_DIFFERENCE * how.x_deviation[:, None])
        slope, residual = (xp.where(xp.isfinite(a), a, 0.0) for a in (slope, found[:, 0]))
        return NormalEquations(
            (found[:, 0] ** 2).sum(axis=1),
            slope @ slope.swapaxes(1, 2) + 1e-12 * np.eye(n),
            (slope @ residual[:, :, None])[:, :, 0],
        )

    with np.errstate(all="ignore"):
        if xp is np:
            x = minimise(cost, linearise, guess, _METHOD, _SCHEDULE).theta
        else:
            x = traced_minimum(cost, linearise, guess, _METHOD, _SCHEDULE)
        return structure.simulate(params, x, u)[0][:, -1]
