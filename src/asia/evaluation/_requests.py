"""In which order and in which batches cases go to a worker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.data import Array
from asia.protocol import Block
from asia.sandbox import Worker
from asia.scoring import check_reply

MOST_TRAINING_WINDOWS = 256


def simulate_held_out(
    worker: Worker, blocks: Sequence[Block], horizon: int | None
) -> tuple[Array, ...]:
    """Simulated outputs (H, ny) of blocks whose outputs are kept back, in the order of `blocks`.

    A later past window is an earlier block's answer. Whole blocks go one a request, in time order;
    windows as `time_order` groups them. Raises CandidateError.
    """
    return _replies(worker, blocks, held_out_requests(blocks, horizon))


def held_out_requests(blocks: Sequence[Block], horizon: int | None) -> list[list[int]]:
    """The requests of `simulate_held_out`, as lists of indices into `blocks`."""
    if horizon is None:
        return [[i] for i in range(len(blocks))]
    return time_order([block.record for block in blocks])


def simulate_training(
    worker: Worker, blocks: Sequence[Block], horizon: int | None
) -> tuple[Array, ...]:
    """The same for blocks whose outputs the candidate was given: many windows a request."""
    if horizon is None:
        return simulate_held_out(worker, blocks, None)
    count = -(-len(blocks) // MOST_TRAINING_WINDOWS)
    requests = [part.tolist() for part in np.array_split(np.arange(len(blocks)), max(count, 1))]
    return _replies(worker, blocks, requests)


def time_order(records: Sequence[int]) -> list[list[int]]:
    """Requests, as lists of indices into `records`, the record of each window; the windows of a
    record stand in time order.

    A request holds at most one window of each record, and a record's windows go in time order, a
    request each. There are as few requests as the longest record allows and their sizes differ by
    one at most (McNaughton's wrap-around schedule, Management Science 6(1), 1959: records laid end
    to end and cut into lanes), so that a model compiles for two batch sizes at most.
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


def _replies(
    worker: Worker, blocks: Sequence[Block], requests: Sequence[Sequence[int]]
) -> tuple[Array, ...]:
    """One reply for each block. Smaller requests repeat their first case up to the size of the
    largest, so that a model compiles once."""
    found: dict[int, Array] = {}
    size = max((len(request) for request in requests), default=0)
    for request in requests:
        cases = [blocks[i].case for i in (*request, *[request[0]] * (size - len(request)))]
        y_hat = worker.simulate(
            np.stack([case.past_u for case in cases]),
            np.stack([case.past_y for case in cases]),
            np.stack([case.u for case in cases]),
        )
        for index, simulated in zip(request, y_hat, strict=False):
            check_reply(simulated, blocks[index].y.shape)
            found[index] = simulated
    return tuple(found[i] for i in range(len(blocks)))
