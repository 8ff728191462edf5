"""Lagged signals: regressors of input-output models, and the lags before a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._numerics.encoder import Encoder, fit_encoder
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    flat_past,
    past_length,
    past_windows,
    window_rows,
)

# Greatest number of windows in the regression of missing lags.
_MOST_WINDOWS = 4000
# Least share of samples with measured lags at which the others are left out.
_ENOUGH = 0.1


@dataclass(frozen=True)
class Lags:
    """Orders of the regressors y[k-1] .. y[k-outputs] and u[k-delay] .. u[k-delay-inputs+1]."""

    outputs: int  # Number of lagged outputs
    inputs: int  # Number of lagged inputs
    delay: int = 0  # Number of samples before the newest input

    @property
    def past_inputs(self) -> int:
        """Number of inputs needed from before the sample that is computed."""
        return max(self.delay + self.inputs - 1, 0)

    @property
    def memory(self) -> int:
        """Number of samples needed before the first one that can be computed."""
        return max(self.outputs, self.past_inputs)


def lagged_inputs(u: AnyArray, lags: Lags) -> AnyArray:
    """Lagged inputs, the newest first: u (..., past_inputs + T, nu) -> (..., T, inputs * nu)."""
    length = u.shape[-2] - lags.past_inputs
    newest = lags.inputs - 1 if lags.inputs else 0
    parts = [u[..., newest - i : newest - i + length, :] for i in range(lags.inputs)]
    empty = u[..., : max(length, 0), :0]
    return namespace(u).concatenate([empty, *parts], axis=-1)


def regressors(
    record: ScaledTrajectory, lags: Lags, first: int | None = None
) -> tuple[Array, Array, Array]:
    """Regressors and targets of a record.

    An output counts where it was measured and, where enough rows are left, all lagged outputs too.
    The first sample is that after the memory of the lags unless `first` is given.

    Returns:
        Regressors (N, outputs * ny + inputs * nu), outputs before inputs and the newest first,
        targets (N, ny) and their weight (N, ny).
    """
    start = lags.memory if first is None else first
    rows, lagged = np.arange(start, len(record)), np.arange(1, lags.outputs + 1)
    known = record.counts[rows] > 0
    if not (known.all() or record.filled):
        seen = (record.counts[rows[:, None] - lagged] > 0).reshape(len(rows), -1)
        whole = known & seen.all(axis=1, keepdims=True)
        known = np.where(whole.sum(axis=0) > _ENOUGH * len(rows), whole, known)
    past = record.y[rows[:, None] - lagged].reshape(len(rows), -1)
    back = lags.delay + np.arange(lags.inputs)
    drive = record.u[rows[:, None] - back].reshape(len(rows), -1)
    return np.concatenate([past, drive], axis=1), record.y[rows], known.astype(np.float64)


@dataclass(frozen=True)
class History:
    """Lags before the first simulated sample, from the past window."""

    lags: Lags  # The lags of the model
    missing_y: int  # Oldest lagged outputs that the window is too short for
    missing_u: int  # Oldest lagged inputs that it is too short for
    encoder: Encoder | None
    """Regression of the missing lags on the window and the first input; without one the oldest
    known value is repeated."""

    def __call__(
        self, past_u: AnyArray, past_y: AnyArray, u: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Lags before the first sample, the oldest first: past_u (B, n_past_u, nu), past_y (B,
        n_past_y, ny), u (B, H, nu) -> inputs (B, past_inputs, nu) and outputs (B, outputs, ny)."""
        xp = namespace(past_u, past_y, u)
        batch, nu, ny = len(u), u.shape[2], past_y.shape[2]
        known_u = past_u[:, past_u.shape[1] - (self.lags.past_inputs - self.missing_u) :]
        known_y = past_y[:, past_y.shape[1] - (self.lags.outputs - self.missing_y) :]
        if self.encoder is not None:
            guess = self.encoder(_features(past_u, past_y, u[:, 0]))
            split = self.missing_u * nu
            old_u = guess[:, :split].reshape(batch, self.missing_u, nu)
            old_y = guess[:, split:].reshape(batch, self.missing_y, ny)
        else:
            oldest_u = xp.concatenate([past_u, u], axis=1)[:, :1]
            oldest_y = past_y[:, :1] if past_y.shape[1] else np.zeros((batch, 1, ny))
            old_u = xp.repeat(oldest_u, self.missing_u, axis=1)
            old_y = xp.repeat(oldest_y, self.missing_y, axis=1)
        return xp.concatenate([old_u, known_u], axis=1), xp.concatenate([old_y, known_y], axis=1)


def fit_history(
    records: ScaledData, lags: Lags, context: Context, outputs: Sequence[Array] | None = None
) -> History:
    """Fit the regression of the lags that the past window is too short for.

    Simulated outputs (T, ny) of each record, valid from the past window on, replace all lagged
    outputs; None uses the measured ones.
    """
    missing_u = max(0, lags.past_inputs - context.n_past_u)
    missing_y = max(0, lags.outputs - context.n_past_y)
    past = past_length(context)
    first = max(past, lags.memory)
    if outputs is not None:
        missing_y, first = lags.outputs, max(first, past + lags.outputs)
    if missing_u + missing_y == 0:
        return History(lags, 0, 0, None)
    signals = outputs if outputs is not None else [r.y for r in records]
    stride = max(1, sum(len(r) for r in records) // _MOST_WINDOWS)
    features: list[Array] = []
    targets: list[Array] = []
    for r, y, at in zip(records, signals, window_rows(records, context), strict=True):
        rows = np.arange(first, len(r), stride)
        rows = rows[np.isin(rows - past, np.arange(max(0, len(r) - past))[at])]
        if len(rows) == 0:
            continue
        old_u = r.u[rows[:, None] - lags.past_inputs + np.arange(missing_u)]
        old_y = y[rows[:, None] - lags.outputs + np.arange(missing_y)]
        targets.append(np.concatenate([a.reshape(len(rows), -1) for a in (old_u, old_y)], axis=1))
        features.append(np.concatenate([past_windows(r, context)[rows - past], r.u[rows]], axis=1))
    if sum(len(t) for t in targets) < 2:
        measured = max(0, lags.outputs - context.n_past_y)
        return History(lags, measured, missing_u, None)
    return History(lags, missing_y, missing_u, fit_encoder(features, targets))


def _features(past_u: AnyArray, past_y: AnyArray, first: AnyArray) -> AnyArray:
    before = flat_past(past_u, past_y)
    return namespace(before, first).concatenate([before, first], axis=1)


@dataclass(frozen=True)
class OutputRange:
    """Range that outputs in free run are clipped to, z-scored."""

    low: Array  # (ny,)
    high: Array  # (ny,)

    @classmethod
    def of(cls, records: ScaledData, margin: float) -> OutputRange:
        """Range of the records, widened on each side by `margin` times its width."""
        y = np.concatenate([r.y for r in records])
        low, high = y.min(axis=0), y.max(axis=0)
        return cls(low - margin * (high - low), high + margin * (high - low))
