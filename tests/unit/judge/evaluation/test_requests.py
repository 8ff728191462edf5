"""Order of held-out cases: a later past window would reveal an earlier window's output, and a later
input is not known to an earlier one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Array, Trajectory
from asia.data.segment import Segment
from asia.judge.evaluation.requests import (
    MOST_SESSIONS,
    MOST_TRAINING_WINDOWS,
    sessions,
    simulate_each,
    simulate_held_out,
    simulate_training,
)
from asia.problem.folds import whole
from asia.problem.protocol import ProtocolRule

RULE = ProtocolRule(kind="windows", horizon=4, past_inputs=0, past_outputs=1)


class Recorder:
    """Stands for a worker: keeps what it is sent; its simulation is the sum of u so far."""

    has_steps = True

    def __init__(self) -> None:
        self.sent: list[Array] = []

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        del secret
        return self.simulate_known(past_u, past_y, u)

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        del past_u
        self.sent.append(past_y[:, -1, 0])
        return past_y[:, -1:] + np.cumsum(u, axis=1)


def blocks(lengths: Sequence[int], rule: ProtocolRule = RULE) -> tuple[Segment, ...]:
    """Record r holds 1000 r, 1000 r + 1, ..., so that a past window names record and time."""
    values = [1000.0 * r + np.arange(n) for r, n in enumerate(lengths)]
    return whole([Trajectory(np.ones(len(v)), v, 1.0, str(v[0])) for v in values], rule)


def check(found: Sequence[Segment], y_hat: Sequence[Array]) -> None:
    for block, simulated in zip(found, y_hat, strict=True):
        assert np.array_equal(simulated, block.y)


@given(st.lists(st.integers(5, 60), min_size=1, max_size=30))
def test_no_worker_knows_an_input_before_its_time(lengths: list[int]) -> None:
    found = blocks(lengths)
    parts = sessions(found)
    assert sorted(i for part in parts for i in part) == list(range(len(found)))
    assert len(parts) <= MOST_SESSIONS
    for part in parts:
        for record in {found[i].record for i in part}:
            own = [found[i] for i in part if found[i].record == record]
            for one, other in pairwise(own):
                assert one.stop <= other.start
    if len(parts) < MOST_SESSIONS:
        assert all(len({found[i].record for i in part}) == 1 for part in parts)


def test_held_out_windows_arrive_one_by_one_in_time_order() -> None:
    found, worker = blocks([13, 17, 9]), Recorder()
    check(found, simulate_held_out(worker, found))
    assert all(len(request) == 1 for request in worker.sent)
    sent = [float(request[0]) for request in worker.sent]
    assert sent == sorted(sent)


def test_windows_of_library_models_go_side_by_side() -> None:
    found, worker = blocks([13, 17, 9]), Recorder()
    answers = simulate_each(worker, found, range(len(found)), b"x", together=True)
    check(found, [answers[i] for i in range(len(found))])
    assert [len(request) for request in worker.sent] == [len(found)]
    uneven = blocks([9, 5, 9], ProtocolRule(past_inputs=0, past_outputs=1))
    worker = Recorder()
    answers = simulate_each(worker, uneven, range(3), b"x", together=True)
    check(uneven, [answers[i] for i in range(3)])
    assert [request.tolist() for request in worker.sent] == [[0.0, 2000.0], [1000.0]]


def test_training_windows_go_in_few_large_requests() -> None:
    found, worker = blocks([1401, 801]), Recorder()
    check(found, simulate_training(worker.simulate_known, found, 4))
    assert [len(request) for request in worker.sent] == [184, 184, 184]
    assert max(len(request) for request in worker.sent) <= MOST_TRAINING_WINDOWS


def test_whole_blocks_go_one_by_one() -> None:
    rule = ProtocolRule(past_inputs=0, past_outputs=1)
    found = blocks([9, 5], rule)
    one, other = Recorder(), Recorder()
    check(found, simulate_held_out(one, found))
    check(found, simulate_training(other.simulate_known, found, None))
    for worker in (one, other):
        assert [request.tolist() for request in worker.sent] == [[0.0], [1000.0]]
