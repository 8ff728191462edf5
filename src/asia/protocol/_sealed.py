"""The only opener of test outputs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asia.errors import UserError
from asia.problem import Trajectory
from asia.problem._blocks import least_case
from asia.problem._digest import data_digest
from asia.problem._problem import Problem, Seal
from asia.problem._sources import Channels, read_records

__all__ = ["Seal", "open_test", "seal"]

_RUN = 10


def seal(problem: Problem) -> Seal:
    """Reads the test records, checks that they can be scored, keeps their digest and drops them.

    Raises UserError when they cannot be read, do not fit the problem, or are too short for the
    past window and protocol.test.skip, or for one window.
    """
    if problem.test.source is None:
        return Seal(None)
    records = _read(problem)
    rule = problem.protocol
    least = rule.past + rule.test.skip + least_case(rule)
    for record in records:
        if rule.horizon is not None and len(record) < least:
            raise UserError(
                f"test record '{record.name}' has {len(record)} samples, but the past window and "
                f"one window of {rule.horizon} need {least}: bring a longer record"
            )
        if len(record) < least:
            raise UserError(
                f"test record '{record.name}' has {len(record)} samples, but the past window and "
                f"protocol.test.skip leave out {least - 1}: shorten them or bring a longer record"
            )
    return Seal(
        sha256=data_digest(records),
        names=tuple(r.name for r in records),
        lengths=tuple(len(r) for r in records),
        shared_samples=sum(_shared(r, problem.train) for r in records),
    )


def open_test(problem: Problem) -> tuple[Trajectory, ...]:
    """The test records. Raises UserError when there are none, or when they are not the ones
    that were sealed."""
    if problem.test.source is None:
        raise UserError(
            f"problem '{problem.name}' has no test data: name some in [data] test and start a "
            "new run"
        )
    records = _read(problem)
    if problem.test.sha256 is not None and data_digest(records) != problem.test.sha256:
        raise UserError(
            f"the test data of problem '{problem.name}' changed since they were sealed: put them "
            "back, or start a new run"
        )
    return records


def _read(problem: Problem) -> tuple[Trajectory, ...]:
    assert problem.test.source is not None
    channels = Channels(problem.inputs, problem.outputs, problem.sampling_time)
    return read_records(problem.test.source, "test", channels).trajectories


def _shared(record: Trajectory, train: tuple[Trajectory, ...]) -> int:
    """Samples of `record` inside runs of ten that also occur in a training record."""
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
