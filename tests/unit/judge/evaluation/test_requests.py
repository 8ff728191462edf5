"""Windows in one request: a later past window would reveal an earlier window's output."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Array, Trajectory
from asia.judge.evaluation.requests import (
    MOST_TRAINING_WINDOWS,
    simulate_held_out,
    simulate_training,
    time_order,
)
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.folds import Block, whole
from asia.problem.protocol import ProtocolRule

RULE = ProtocolRule(kind="windows", horizon=4, past_inputs=0, past_outputs=1)


class Recorder:
    """Stands for a worker: keeps what it is sent; its simulation is the sum of u so far."""

    def __init__(self) -> None:
        self.sent: list[Array] = []

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        del past_u
        self.sent.append(past_y[:, -1, 0])
        return past_y[:, -1:] + np.cumsum(u, axis=1)


def blocks(lengths: Sequence[int], rule: ProtocolRule = RULE) -> tuple[Block, ...]:
    """Record r holds 1000 r, 1000 r + 1, ..., so that a past window names record and time."""
    values = [1000.0 * r + np.arange(n) for r, n in enumerate(lengths)]
    return whole([Trajectory(np.ones(len(v)), v, 1.0, str(v[0])) for v in values], rule)


def ask(simulate: object, found: tuple[Block, ...], horizon: int | None) -> list[Array]:
    worker = Recorder()
    y_hat = simulate(cast(Worker, worker), found, horizon)  # type: ignore[operator]
    for block, simulated in zip(found, y_hat, strict=True):
        assert np.array_equal(simulated, block.y)
    return worker.sent


@given(st.lists(st.integers(1, 30), min_size=1, max_size=8))
def test_a_window_is_sent_after_all_earlier_ones_of_its_record(counts: list[int]) -> None:
    records = [r for r, count in enumerate(counts) for _ in range(count)]
    requests = time_order(records)
    assert sorted(i for request in requests for i in request) == list(range(len(records)))
    for request in requests:
        owners = [records[i] for i in request]
        assert len(set(owners)) == len(owners)
    turn = {i: t for t, request in enumerate(requests) for i in request}
    for i in range(1, len(records)):
        if records[i] == records[i - 1]:
            assert turn[i] > turn[i - 1]
    assert len(requests) == max(counts)
    sizes = [len(request) for request in requests]
    assert max(sizes) - min(sizes) <= 1


def test_runs_of_one_length_go_side_by_side() -> None:
    assert time_order([0, 0, 0, 1, 1, 1]) == [[0, 3], [1, 4], [2, 5]]
    assert time_order([]) == []


def test_held_out_windows_arrive_in_time_order_in_batches_of_one_size() -> None:
    sent = ask(simulate_held_out, blocks([13, 17, 9]), 4)
    assert {len(request) for request in sent} == {3}
    seen: dict[int, float] = {}
    for request in sent:
        for record in {int(v // 1000) for v in request}:
            times = {float(v) for v in request if v // 1000 == record}
            assert len(times) == 1
            assert times.pop() > seen.get(record, -1.0)
            seen[record] = max(float(v) for v in request if v // 1000 == record)


def test_training_windows_go_in_few_large_requests() -> None:
    found = blocks([1401, 801])
    sent = ask(simulate_training, found, 4)
    assert [len(request) for request in sent] == [184, 184, 184]
    assert max(len(request) for request in sent) <= MOST_TRAINING_WINDOWS


def test_whole_blocks_go_one_by_one() -> None:
    rule = ProtocolRule(past_inputs=0, past_outputs=1)
    for simulate in (simulate_held_out, simulate_training):
        sent = ask(simulate, blocks([9, 5], rule), None)
        assert [request.tolist() for request in sent] == [[0.0], [1000.0]]
