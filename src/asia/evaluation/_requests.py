"""Order and batches of the cases that go to a worker."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from asia.data import Array
from asia.protocol import Block
from asia.scoring import check_reply

MOST_TRAINING_WINDOWS = 256


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
    requests = held_out_requests(blocks, horizon)
    found = simulate_requests(worker, blocks, requests, largest(requests))
    return tuple(found[i] for i in range(len(blocks)))


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
    requests = [part.tolist() for part in np.array_split(np.arange(len(blocks)), max(count, 1))]
    found = simulate_requests(worker, blocks, requests, largest(requests))
    return tuple(found[i] for i in range(len(blocks)))


def spread(blocks: Sequence[Block], most: int) -> tuple[Block, ...]:
    """Choose at most `most` of the blocks, evenly spread."""
    places = np.linspace(0, len(blocks) - 1, min(len(blocks), most)).round().astype(int)
    return tuple(blocks[place] for place in places.tolist())


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
