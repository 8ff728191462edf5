"""Test samples that duplicate training samples or lie outside the training input range."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asia.data._trajectory import Trajectory

_RUN = 10


def shared_samples(test: Sequence[Trajectory], train: Sequence[Trajectory]) -> int:
    """Samples of the test records inside runs of ten that also occur in a training record."""
    own = [_run_hashes(record) for record in test]
    # Test records are the shorter ones: every training record is looked up in them, one by one.
    wanted = (
        np.sort(np.concatenate([hashes for hashes, _ in own])) if own else np.zeros(0, np.uint64)
    )
    if wanted.size == 0:
        return 0
    copied = np.zeros(0, np.uint64)
    for record in train:
        hashes = _run_hashes(record)[0]
        copied = np.concatenate([copied, hashes[_is_in(hashes, wanted)]])
    copied = np.sort(copied)
    return sum(
        _covered(len(record), _is_in(hashes, copied) & moves)
        for record, (hashes, moves) in zip(test, own, strict=True)
    )


def samples_outside(test: Sequence[Trajectory], train: Sequence[Trajectory]) -> tuple[int, ...]:
    """Count the test samples of each input that exceed the training range by more than a hundredth
    of it."""
    u = [record.u for record in train]
    low = np.min([values.min(axis=0) for values in u], axis=0)
    high = np.max([values.max(axis=0) for values in u], axis=0)
    edge = 0.01 * (high - low)
    outside = [((r.u < low - edge) | (r.u > high + edge)).sum(axis=0) for r in test]
    return tuple(int(count) for count in np.sum(outside, axis=0))


def _is_in(values: NDArray[np.uint64], ordered: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which values occur in the sorted array `ordered`."""
    if ordered.size == 0:
        return np.zeros(values.shape, dtype=bool)
    places = np.searchsorted(ordered, values)
    places[places == ordered.size] = 0
    return ordered[places] == values


def _covered(samples: int, starts: NDArray[np.bool_]) -> int:
    """Samples inside the runs that begin where `starts` is true."""
    inside = np.zeros(samples, dtype=bool)
    for start in np.flatnonzero(starts):
        inside[start : start + _RUN] = True
    return int(inside.sum())


def _run_hashes(record: Trajectory) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
    """A hash of each run of ten rows, and whether anything moves in it: two records at rest look
    the same without being copies."""
    rows = np.concatenate([record.u, record.y], axis=1)
    bits = rows.view(np.uint64)
    if len(rows) < _RUN:
        return np.zeros(0, np.uint64), np.zeros(0, np.bool_)
    odd = np.random.default_rng(0).integers(1, 2**63, size=(bits.shape[1] + 1,), dtype=np.uint64)
    odd |= np.uint64(1)
    row = ((bits ^ (bits >> np.uint64(32))) * odd[:-1]).sum(axis=1, dtype=np.uint64)
    row ^= row >> np.uint64(29)
    count = len(rows) - _RUN + 1
    hashes = np.zeros(count, np.uint64)
    changes = np.zeros(count, np.int64)
    step = np.any(rows[1:] != rows[:-1], axis=1)
    for k in range(_RUN):
        hashes = hashes * odd[-1] + row[k : k + count]
        if k < _RUN - 1:
            changes += step[k : k + count]
    return hashes, changes > 0
