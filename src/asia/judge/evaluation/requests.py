"""Requests to a worker: order and batches of cases."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from asia.data.trajectory import Array, filled
from asia.judge.scoring.outcome import check_reply
from asia.problem.folds import Block

MOST_TRAINING_WINDOWS = 256

T = TypeVar("T")


class CaseSimulator(Protocol):
    """A fitted model, or a worker that holds one. Raises CandidateError."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate cases as `asia.candidate.Model.simulate`; outputs are finite."""
        ...


def simulate_held_out(
    worker: CaseSimulator, blocks: Sequence[Block], horizon: int | None
) -> tuple[Array, ...]:
    """Simulate held-out blocks whose outputs the evaluator keeps.

    A later past window would reveal an earlier block's outputs. Whole blocks go one a request, in
    time order; windows are grouped as in `time_order`.

    Returns:
        outputs (H, ny) in the order of `blocks`

    Raises:
        CandidateError: when the worker fails
    """
    return _in_order(worker, blocks, held_out_requests(blocks, horizon))


def held_out_requests(blocks: Sequence[Block], horizon: int | None) -> list[list[int]]:
    """The requests of `simulate_held_out`, as lists of indices into `blocks`.

    The rows of a request are in an order drawn from the held-out outputs, which no worker has: the
    row of a window would tell its record, whose other part trains.
    """
    if horizon is None:
        return [[i] for i in range(len(blocks))]
    digest = hashlib.sha256(b"".join(block.y.tobytes() for block in blocks)).digest()
    random = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    requests = time_order([block.record for block in blocks])
    return [random.permutation(request).tolist() for request in requests]


def simulate_training(
    worker: CaseSimulator, blocks: Sequence[Block], horizon: int | None
) -> tuple[Array, ...]:
    """The same for blocks whose outputs the candidate was given: many windows a request."""
    if horizon is None:
        return simulate_held_out(worker, blocks, None)
    count = -(-len(blocks) // MOST_TRAINING_WINDOWS)
    parts = np.array_split(np.arange(len(blocks)), max(count, 1))
    return _in_order(worker, blocks, [part.tolist() for part in parts])


def _in_order(
    worker: CaseSimulator, blocks: Sequence[Block], requests: Sequence[Sequence[int]]
) -> tuple[Array, ...]:
    found = simulate_requests(worker, blocks, requests, largest(requests))
    return tuple(found[i] for i in range(len(blocks)))


def spread(each: Sequence[T], most: int) -> tuple[T, ...]:
    """Choose at most `most`, evenly spread."""
    places = np.linspace(0, len(each) - 1, min(len(each), most)).round().astype(int)
    return tuple(each[place] for place in places.tolist())


def largest(requests: Sequence[Sequence[int]]) -> int:
    """The number of rows in which all of them are sent."""
    return max((len(request) for request in requests), default=0)


def among_strangers(
    requests: Sequence[Sequence[int]], random: np.random.Generator
) -> list[list[int]]:
    """The same cases in requests of the same sizes, in random order and each among other cases.

    A case keeps its row: rounding may depend on the row, on nothing else.
    """
    mixed: list[list[int]] = [[] for _ in requests]
    for row in range(largest(requests)):
        places = [k for k, request in enumerate(requests) if len(request) > row]
        for place, source in zip(places, random.permutation(places).tolist(), strict=True):
            mixed[place].append(requests[source][row])
    return [mixed[k] for k in random.permutation(len(mixed)).tolist()]


def time_order(records: Sequence[int]) -> list[list[int]]:
    """Schedule windows into requests, in time order for each record.

    `records` gives the record of each window; a request is a list of indices into it. A request
    holds at most one window of each record, and a record's windows go in time order, a request
    each. There are as few requests as the longest record allows and their sizes differ by one at
    most (McNaughton's wrap-around schedule, Management Science 6(1), 1959: records laid end to end
    and cut into lanes), so that a model compiles for two batch sizes at most.
    """
    numbers = np.asarray(records, dtype=np.int64)
    if numbers.size == 0:
        return []
    by_record = [np.flatnonzero(numbers == r) for r in dict.fromkeys(numbers.tolist())]
    count = max(len(indices) for indices in by_record)
    requests: list[list[int]] = [[] for _ in range(count)]
    place = 0
    for indices in by_record:
        turns = sorted((place + k) % count for k in range(len(indices)))
        for turn, index in zip(turns, indices.tolist(), strict=True):
            requests[turn].append(index)
        place += len(indices)
    return requests


def simulate_requests(
    worker: CaseSimulator, blocks: Sequence[Block], requests: Sequence[Sequence[int]], rows: int
) -> dict[int, Array]:
    """Simulate the requested blocks.

    Requests with fewer than `rows` cases repeat their first one, so that a model compiles once.

    Returns:
        outputs (H, ny)

    Raises:
        CandidateError: when the worker fails
    """
    found: dict[int, Array] = {}
    for request in requests:
        cases = [blocks[i].case for i in (*request, *[request[0]] * (rows - len(request)))]
        y_hat = worker.simulate(
            np.stack([case.past_u for case in cases]),
            np.stack([case.past_y for case in cases]),
            np.stack([case.u for case in cases]),
        )
        for index, simulated in zip(request, y_hat, strict=False):
            check_reply(simulated, blocks[index].y.shape)
            found[index] = simulated
    return found


def simulate_alone(worker: CaseSimulator, block: Block, row: int, rows: int) -> Array:
    """The simulated outputs (H, ny) in one row of a request that holds nothing but this case, in
    all its rows. Raises CandidateError."""
    case = block.case
    given = (np.repeat(a[None], rows, axis=0) for a in (case.past_u, case.past_y, case.u))
    simulated = worker.simulate(*given)[row]
    check_reply(simulated, block.y.shape)
    return simulated


# Scored requests, and the changed requests that test whether a model is one.

MOST_BATCHES = 6
_MOTION = 3


@dataclass(frozen=True)
class CaseBatch:
    """Request with its simulated outputs."""

    past_u: Array
    """(B, n_past_u, nu)."""
    past_y: Array
    """(B, n_past_y, ny)."""
    u: Array
    """(B, H, nu)."""
    y: Array
    """Measured outputs, (B, H, ny)."""
    y_hat: Array
    """Simulated outputs, (B, H, ny)."""
    count: int
    """Number of rows that are cases; further rows repeat the first."""
    followed: bool = False
    """Whether data that come right after the block train."""

    def moved(self, size: float, scale: Array, random: np.random.Generator) -> Iterator[CaseBatch]:
        """Inputs and past window moved up or down at random by `size` standard deviations; and
        moved the opposite way. One after the other: long ones are large."""
        spread = self.u.std(axis=(0, 1))
        spread = np.where(spread > 0, spread, np.abs(self.u).max(axis=(0, 1)))
        given = (self.past_u, spread), (self.past_y, scale), (self.u, spread)
        steps = [random.choice((-1.0, 1.0), a.shape) for a, _ in given]
        for step, (_, unit) in zip(steps, given, strict=True):
            step *= size * unit
        for way in (np.add, np.subtract):
            past_u, past_y, u = (way(a, d) for (a, _), d in zip(given, steps, strict=True))
            yield replace(self, past_u=past_u, past_y=past_y, u=u)

    def prefix(self, length: int) -> CaseBatch:
        """The same cases with their first `length` inputs alone."""
        return replace(self, u=self.u[:, :length])

    def ending(self, length: int) -> CaseBatch:
        """The last `length` samples of the same cases, started from simulated outputs."""
        start = self.u.shape[1] - length
        return replace(
            self,
            past_u=_past(self.past_u, self.u, start),
            past_y=_past(self.past_y, self.y_hat, start),
            u=self.u[:, start:],
        )

    def later_starts(self, number: int, scale: Array) -> Iterator[tuple[CaseBatch, list[int]]]:
        """Yield the same segments from `number` later starts in the first half, with the sample of
        each row's start. A past window that does not hold the whole state gives a better start
        at rest than in motion. Each part of the first half therefore gives the sample at which
        the outputs move most nearly as fast as at the scored start. After the last input it is
        held."""
        length, half = self.u.shape[1], self.u.shape[1] // 2
        # (B, half + 1): mean absolute step of the outputs over the few samples from each one on.
        y = np.concatenate([self.past_y[:, -1:], self.y], axis=1)
        steps = (np.abs(np.diff(y, axis=1)) / scale).mean(axis=2)
        near = steps[:, : half + 1].copy()
        for ahead in range(1, _MOTION):
            later = steps[:, ahead : half + 1 + ahead]
            near[:, : later.shape[1]] += later
        motion = near / np.minimum(steps.shape[1] - np.arange(half + 1), _MOTION) + 1e-3
        for part in np.array_split(np.arange(1, half + 1), number):
            unlike = np.abs(np.log(motion[:, part] / motion[:, :1]))
            starts = part[unlike.argmin(axis=1)].tolist()
            u = np.empty_like(self.u)
            for row, known, start in zip(u, self.u, starts, strict=True):
                row[: length - start], row[length - start :] = known[start:], known[-1]
            past_u, past_y = (
                _pasts(self.past_u, self.u, starts),
                _pasts(self.past_y, self.y, starts),
            )
            yield replace(self, past_u=past_u, past_y=past_y, u=u), starts


def _pasts(before: Array, values: Array, starts: Sequence[int]) -> Array:
    rows = zip(before[:, None], values[:, None], starts, strict=True)
    return np.concatenate([_past(*row) for row in rows])


def _past(before: Array, values: Array, start: int) -> Array:
    """The samples just before `start`, as many as `before` has of those before sample 0."""
    count = before.shape[1]
    if start >= count:
        return values[:, start - count : start].copy()
    return np.concatenate([before, values[:, :start]], axis=1)[:, start:]


def batches(
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    horizon: int | None,
    random: np.random.Generator,
    followed: Collection[int] = (),
) -> tuple[CaseBatch, ...]:
    """Draw a few of the requests of `simulate_held_out` at random, in the same shapes and order.

    Args:
        y_hat: simulated outputs (H, ny)
        followed: blocks right after which data train
    """
    requests = held_out_requests(blocks, horizon)
    count = min(len(requests), MOST_BATCHES)
    places = np.sort(random.choice(len(requests), count, replace=False))
    most = largest(requests)

    def batch(request: Sequence[int]) -> CaseBatch:
        rows = [*request, *[request[0]] * (most - len(request))]
        cases = [blocks[i].case for i in rows]
        return CaseBatch(
            past_u=np.stack([case.past_u for case in cases]),
            past_y=np.stack([case.past_y for case in cases]),
            u=np.stack([case.u for case in cases]),
            y=_stacked([filled(blocks[i].y) for i in rows]),
            y_hat=_stacked([y_hat[i] for i in rows]),
            count=len(request),
            followed=all(i in followed for i in request),
        )

    return tuple(batch(requests[place]) for place in places)


def _stacked(rows: Sequence[Array]) -> Array:
    """Side by side; a single one, which may be long, without a copy."""
    return rows[0][None] if len(rows) == 1 else np.stack(rows)
