"""Choice among windowed linear models: number of past samples in the state, and ridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.models._data.records import ScaledData, ScaledTrajectory, contiguous_splits, past_length
from asia.models._data.windows import HorizonWindows, cut_windows
from asia.models._linear.fit import Refinement
from asia.models._linear.windows import (
    MOST_PARAMETERS,
    WindowLags,
    WindowPredictor,
    one_step,
    refined,
)

# Ridges against the mean squared error in z-scores, from strong to weak.
_RIDGES = (1.0, 1e-1, 1e-2, 1e-4)
_QUICK_ITERATIONS = 4
# Limits on the work of a refinement: samples times squared parameters.
_SELECTION_WORK, _FINAL_WORK = 4e9, 2e10
_FEWEST, MOST_WINDOWS = 24, 2000


@dataclass(frozen=True)
class WindowedChoice:
    """Lags and ridge, with their errors."""

    lags: WindowLags
    """Past samples kept in the state."""
    ridge: float
    """Ridge against the mean squared error in z-scores."""
    errors: tuple[float, ...]
    """Mean squared error on the windows of each segment left out."""

    @property
    def error(self) -> float:
        """Mean error over all segments."""
        return float(np.mean(self.errors))


def choose(records: ScaledData, context: Context, refinement: Refinement) -> WindowedChoice | None:
    """Choose lags and ridge by the error on segments left out.

    For each number of lags the choice is the strongest ridge within one standard error, over the
    segments, of the best; the result is the best of these, None where the past window is empty.
    """
    splits = held_out(records, context)
    choices = [
        _best_ridge(splits, lags, context, refinement) for lags in _candidates(records, context)
    ]
    return min(choices, key=lambda c: c.error) if choices else None


def held_out(
    records: ScaledData, context: Context
) -> list[tuple[list[ScaledTrajectory], list[ScaledTrajectory]]]:
    """Three splits (kept, left out) with other segments left out each time.

    With enough records these are neighbouring records, since successive records are often of one
    kind.
    """
    if len(records) >= 3:
        groups = np.array_split(np.arange(len(records)), 3)
        return [
            ([r for i, r in enumerate(records) if i not in g], [records[i] for i in g])
            for g in groups
        ]
    return contiguous_splits(records, 3, past_length(context) + 2 * (context.horizon or 1))


def fit_choice(
    records: ScaledData, context: Context, choice: WindowedChoice, refinement: Refinement
) -> WindowPredictor:
    """Refine the chosen lags and ridge on windows from all records."""
    windows = cut_windows(records, context, _count(choice.lags, context, _FINAL_WORK))
    start = one_step(windows, choice.lags, _one_step_ridge(choice.ridge))
    return _refined(start, windows, choice.ridge, refinement.iterations, refinement)


def _candidates(records: ScaledData, context: Context) -> list[WindowLags]:
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    past_u, past_y = context.n_past_u, context.n_past_y
    found: list[WindowLags] = []
    for count in sorted({1, 2, 4, past_length(context)}):
        lags = WindowLags(past_u, past_y, min(count, past_u), min(count, past_y), nu, ny)
        fits = not found or lags.parameters <= MOST_PARAMETERS
        if lags.order and fits and lags not in found:
            found.append(lags)
    return found


def _best_ridge(
    splits: Sequence[tuple[list[ScaledTrajectory], list[ScaledTrajectory]]],
    lags: WindowLags,
    context: Context,
    refinement: Refinement,
) -> WindowedChoice:
    count = _count(lags, context, _SELECTION_WORK)
    errors = np.array(
        [
            _path(cut_windows(kept, context, count), cut_windows(left, context, MOST_WINDOWS), lags,
                  refinement)
            for kept, left in splits
        ]
    )  # fmt: skip
    means = errors.mean(axis=0)
    best = int(np.argmin(means))
    apart = errors - errors[:, best : best + 1]
    limit = apart.std(axis=0, ddof=1) / np.sqrt(len(splits)) if len(splits) > 1 else 0.0 * means
    chosen = int(np.argmax(means - means[best] <= limit))
    return WindowedChoice(lags, _RIDGES[chosen], tuple(errors[:, chosen].tolist()))


def _path(
    kept: HorizonWindows, left: HorizonWindows, lags: WindowLags, refinement: Refinement
) -> list[float]:
    """Mean squared error on `left` along the ridges, each fit started from the one before."""
    current, errors = one_step(kept, lags, _one_step_ridge(_RIDGES[0])), list[float]()
    for ridge in _RIDGES:
        current = _refined(current, kept, ridge, _QUICK_ITERATIONS, refinement)
        errors.append(min(current.error(left), 1e12))
    return errors


def _refined(
    start: WindowPredictor,
    windows: HorizonWindows,
    ridge: float,
    iterations: int,
    refinement: Refinement,
) -> WindowPredictor:
    if start.lags.parameters > MOST_PARAMETERS:
        return one_step(windows, start.lags, _one_step_ridge(ridge))
    return refined(
        start,
        windows,
        ridge,
        min(iterations, refinement.iterations),
        max(refinement.tolerance, 1e-4),
    )


def _one_step_ridge(ridge: float) -> float:
    # One-step errors are smaller than those over a horizon, and so is their ridge.
    return max(1e-4 * ridge, 1e-9)


def _count(lags: WindowLags, context: Context, work: float) -> int:
    each = (context.horizon or 1) * lags.ny * lags.parameters**2
    return int(np.clip(work / each, _FEWEST, MOST_WINDOWS))
