"""Training windows: segments of the protocol's horizon, each with its own past window."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.cuts import rows, spread
from asia.models._data.records import ScaledData, ScaledTrajectory, past_length, windows

# Greatest number of segments from one record: few long ones, so that slow modes show.
_MOST_SEGMENTS = 4


class HorizonWindows(NamedTuple):
    """Windows side by side, z-scored; JAX reads it as a tree of its arrays."""

    features: Any
    """Past windows, flattened (W, d)."""
    u: Any
    """Inputs after them (W, H, nu)."""
    y: Any
    """Outputs after them (W, H, ny)."""
    weight: Any = None
    """(W, H), 0 where an output was not measured; None where all samples count."""

    def each(self, change: Callable[[Any], Any]) -> HorizonWindows:
        """Apply a function to every array."""
        return HorizonWindows(*(None if a is None else change(a) for a in self))


def cut_windows(records: ScaledData, context: Context, most: int) -> HorizonWindows:
    """Cut at most about `most` windows of `context.horizon` samples (of the longest record, where
    all are shorter), evenly spread over the records and of every record the same share."""
    past = past_length(context)
    longest = max(len(r) for r in records) - past
    horizon = min(context.horizon or longest, longest)
    usable = [r for r in records if len(r) - past >= horizon]
    places = [len(r) - past - horizon + 1 for r in usable]
    stride = max(1, -(-sum(places) // max(most, 1)))
    features: list[Array] = []
    u: list[Array] = []
    y: list[Array] = []
    counts: list[Array] = []
    for r, count in zip(usable, places, strict=True):
        starts = np.arange((count - 1) % stride // 2, count, stride)
        simulated = rows(past + starts, horizon)
        features.append(windows(r, context)[starts])
        u.append(r.u[simulated])
        y.append(r.y[simulated])
        counts.append(r.counts[simulated])
    weight = _weight(np.concatenate(counts))
    return HorizonWindows(np.concatenate(features), np.concatenate(u), np.concatenate(y), weight)


def whole_windows(records: ScaledData, context: Context, horizon: int, most: int) -> HorizonWindows:
    """Cut at most about `most` windows of `horizon` samples that lie end to end in each record,
    none cut by its end, spread over all records."""
    past = past_length(context)
    counts = [(len(r) - past) // horizon for r in records]
    stride = max(1, round(sum(max(count, 1) for count in counts) / most))
    places = [(i, k * horizon) for i, count in enumerate(counts) for k in range(count)][::stride]
    features = [windows(r, context) for r in records]
    segments = [records[i].part(past + k, horizon) for i, k in places]
    return HorizonWindows(
        np.stack([features[i][k] for i, k in places]),
        np.stack([segment.u for segment in segments]),
        np.stack([segment.y for segment in segments]),
        _weight(np.stack([segment.counts for segment in segments])),
    )


def mean_square(error: Array, weight: Array | None) -> float:
    """Mean square of errors (W, H, ny) where weight (W, H) is 1."""
    if weight is None:
        return float((error**2).mean())
    total = max(float(weight.sum()) * error.shape[-1], 1.0)
    return float((weight[..., None] * error**2).sum()) / total


def _weight(counts: Array) -> Array | None:
    return None if counts.all() else counts


def stretches(records: ScaledData, samples: int, shortest: int) -> list[ScaledTrajectory]:
    """Choose segments of up to about `samples` samples in all.

    These are the records themselves where they hold no more, else segments of at least `shortest`
    samples (where a record has them), evenly spread over each record, of very many records only
    over
    some.
    """
    total = sum(len(r) for r in records)
    if total <= samples:
        return list(records)
    most = max(1, samples // shortest)
    kept = [records[i] for i in spread(len(records), most)]
    share = samples / sum(len(r) for r in kept)
    segments: list[ScaledTrajectory] = []
    for r in kept:
        count = int(np.clip(share * len(r) // shortest, 1, _MOST_SEGMENTS))
        length = min(len(r), max(shortest, int(share * len(r) / count)))
        starts = np.linspace(0, len(r) - length, count).round().astype(int)
        segments += [r.part(int(start), length) for start in starts]
    return segments
