"""Test samples that are copies of training samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asia.data._trajectory import Trajectory

_RUN = 10


def shared_samples(test: Sequence[Trajectory], train: Sequence[Trajectory]) -> int:
    """Samples of the test records inside runs of ten that also occur in a training record."""
    return sum(_shared(record, train) for record in test)


def _shared(record: Trajectory, train: Sequence[Trajectory]) -> int:
    own, moves = _run_hashes(record)
    if own.size == 0:
        return 0
    known = np.concatenate([_run_hashes(t)[0] for t in train])
    hit = np.isin(own, known) & moves
    inside = np.zeros(len(record), dtype=bool)
    for start in np.flatnonzero(hit):
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
