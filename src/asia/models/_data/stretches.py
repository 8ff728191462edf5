"""Segments over which a model is simulated for its fit or choice, and the error on them.

With a horizon they are windows of that length, as the model will be evaluated; without one they are
whole records.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from asia.candidate import Context
from asia.data import Array, Trajectory
from asia.models._data.cuts import laid_end_to_end, side_by_side, spread
from asia.models._data.records import ScaledData, contiguous_splits, past_length

# Longest segment in samples. Longer records are cut and their segments simulated side by side: the
# time of a loop grows with its length.
_LONGEST = 4000
_MOST_SAMPLES = 40_000


@dataclass(frozen=True)
class Stretches:
    """Segments side by side, z-scored, padded with zeros where the weight is zero."""

    past_u: Array
    """Inputs before each (S, n_past_u, nu)."""
    past_y: Array
    """Outputs before each (S, n_past_y, ny)."""
    u: Array
    """(S, H, nu)."""
    y: Array
    """(S, H, ny)."""
    weight: Array
    """(S, H)."""

    def __len__(self) -> int:
        return len(self.u)


class ScaledSimulator(Protocol):
    """Fitted model in z-scores."""

    def __call__(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate as `simulate` of a model does, all z-scored."""
        ...


def segments(
    records: ScaledData, context: Context, samples: int = _MOST_SAMPLES
) -> Stretches | None:
    """Segments of the records after their past windows, about `samples` in total.

    They are evenly spread where there are more.

    Returns:
        None where every record is too short for one.
    """
    past = past_length(context)
    places = [(r, first) for r in records for first in _firsts(len(r), past, context.horizon)]
    if not places:
        return None
    longest = context.horizon or _LONGEST
    lengths = [min(longest, len(r) - first) for r, first in places]
    most = max(1, samples // max(lengths))
    chosen = spread(len(places), most)
    cuts = [(*places[i], places[i][1] + lengths[i]) for i in chosen]
    return Stretches(
        np.stack([r.measured_u[k - context.n_past_u : k] for r, k, _ in cuts]),
        np.stack([r.y[k - context.n_past_y : k] for r, k, _ in cuts]),
        side_by_side([r.u[k:end] for r, k, end in cuts]),
        side_by_side([r.y[k:end] for r, k, end in cuts]),
        side_by_side([r.counts[k:end] for r, k, end in cuts]),
    )


def simulation_error(simulate: ScaledSimulator, data: Stretches) -> float:
    """Weighted mean squared error over samples and channels, infinite where it diverges."""
    with np.errstate(all="ignore"):
        misfit = simulate(data.past_u, data.past_y, data.u) - data.y
        total = float((data.weight[..., None] * misfit**2).sum())
    total /= max(float(data.weight.sum()) * data.y.shape[-1], 1.0)
    return total if np.isfinite(total) else float("inf")


def left_out_error(
    records: ScaledData,
    context: Context,
    fit: Callable[[ScaledData], Sequence[ScaledSimulator]],
    shortest: int,
) -> Array:
    """Mean over splits of the log of the mean squared simulation error on the samples left out.

    Whole records are left out when there are at least three, else segments of them of at least
    `shortest` samples.

    Args:
        records: records in z-scores.
        context: context of the fit.
        fit: makes simulators from the kept samples.
        shortest: least samples of a segment.

    Returns:
        One number for each simulator; infinite where one diverges.
    """
    logs: list[list[float]] = []
    for kept, left in contiguous_splits(records, 3, shortest):
        data = segments(left, context)
        if data is None or not kept:
            continue
        logs.append([np.log(simulation_error(s, data) + 1e-300) for s in fit(kept)])
    return np.mean(logs, axis=0) if logs else np.zeros(1)


def window_pieces(
    trajectories: Sequence[Trajectory], context: Context, most: int
) -> list[Trajectory]:
    """Cut past window and horizon as separate records, `most` of them spread evenly; the records
    themselves where the protocol has no horizon."""
    if context.horizon is None:
        return list(trajectories)
    past, horizon = past_length(context), context.horizon
    places = [(t, k - past) for t in trajectories for k in _firsts(len(t), past, horizon)]
    kept = [places[i] for i in spread(len(places), most)]
    return [t[k : k + past + horizon] for t, k in kept]


def _firsts(length: int, past: int, horizon: int | None) -> list[int]:
    """First simulated samples; the last window ends with the record."""
    starts = laid_end_to_end(length - past, horizon or _LONGEST, overlap=horizon is not None)
    return (past + starts).tolist()
