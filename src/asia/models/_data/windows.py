"""Training windows: stretches of the protocol's horizon, each with its own past window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.records import ScaledData, ScaledTrajectory, past_length, windows

# Stretches cut from one record: long ones, so that slow modes show.
_PIECES = 4


@dataclass(frozen=True)
class HorizonWindows:
    """z-scored: features (W, d), the past windows; u (W, H, nu) and y (W, H, ny) after them."""

    features: Array
    u: Array
    y: Array

    def __len__(self) -> int:
        return len(self.features)


def cut_windows(records: ScaledData, context: Context, most: int) -> HorizonWindows:
    """At most about `most` windows of `context.horizon` samples (of the longest record, where all
    are shorter), evenly spread over the records and of every record the same share."""
    past = past_length(context)
    longest = max(len(r) for r in records) - past
    horizon = min(context.horizon or longest, longest)
    usable = [r for r in records if len(r) - past >= horizon]
    places = [len(r) - past - horizon + 1 for r in usable]
    stride = max(1, -(-sum(places) // max(most, 1)))
    features: list[Array] = []
    u: list[Array] = []
    y: list[Array] = []
    for r, count in zip(usable, places, strict=True):
        starts = np.arange((count - 1) % stride // 2, count, stride)
        rows = starts[:, None] + past + np.arange(horizon)
        features.append(windows(r, context)[starts])
        u.append(r.u[rows])
        y.append(r.y[rows])
    return HorizonWindows(np.concatenate(features), np.concatenate(u), np.concatenate(y))


def stretches(records: ScaledData, samples: int, shortest: int) -> list[ScaledTrajectory]:
    """Up to about `samples` samples in all: the records themselves where they hold no more, else
    stretches of at least `shortest` (where a record has them), evenly spread over each record, of
    very many records only over some."""
    total = sum(len(r) for r in records)
    if total <= samples:
        return list(records)
    most = max(1, samples // shortest)
    rows = np.linspace(0, len(records) - 1, min(len(records), most)).round().astype(int)
    kept = [records[i] for i in rows]
    share = samples / sum(len(r) for r in kept)
    pieces: list[ScaledTrajectory] = []
    for r in kept:
        count = int(np.clip(share * len(r) // shortest, 1, _PIECES))
        length = min(len(r), max(shortest, int(share * len(r) / count)))
        for start in np.linspace(0, len(r) - length, count).round().astype(int):
            part = slice(int(start), int(start) + length)
            pieces.append(
                ScaledTrajectory(r.u[part], r.y[part], r.weight[part], r.measured_u[part])
            )
    return pieces
