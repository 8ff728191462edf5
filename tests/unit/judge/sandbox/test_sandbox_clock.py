"""Seconds of a worker by activity, also as reported by a worker that lies."""

import math
import struct
from collections.abc import Callable

import pytest

from asia._timer import Activity
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.compilation import Meter
from asia.judge.sandbox.worker.process import WorkerClock
from asia.judge.sandbox.worker.worker import Worker

from .conftest import Case


@pytest.fixture
def level() -> Isolation:
    """The strongest one: none of this depends on the layers."""
    return probe().level


GAIN = """
import numpy as np

class Gain:
    def simulate(self, past_u, past_y, u):
        return np.repeat(u, 2, axis=2)

def fit(trajectories, context):
    return Gain()
"""
BUSY = GAIN.replace(
    "    return Gain()", "    sum(i * i for i in range(2_000_000))\n    return Gain()"
)
COMPILES = GAIN.replace(
    "    return Gain()",
    "    import jax\n    jax.jit(lambda x: jax.numpy.sin(x) @ x)(np.ones(9))\n    return Gain()",
)
LIES = """
import __main__
import time
__main__.compilation.Meter.tobytes = lambda self, requests: ANSWER
"""


def clock(**seconds: float) -> WorkerClock:
    found = WorkerClock(lambda: None)
    found.spent = {Activity[name]: (value, value / 2) for name, value in seconds.items()}
    return found


def said(*numbers: float) -> bytes:
    return struct.pack("<6d", *numbers, *[0.0] * (6 - len(numbers)))


def test_compilation_is_taken_out_of_where_it_happened() -> None:
    one = clock(FIT=10.0, IMPORT=4.0, SIMULATE=6.0)
    one.count_compiling(said(1.0, 2.0, 0.5, 0.0, 0.0, 3.0))
    assert one.spent[Activity.TRACE] == pytest.approx((1.5, 0.75))
    assert one.spent[Activity.COMPILE] == pytest.approx((5.0, 2.5))
    assert one.spent[Activity.FIT] == pytest.approx((7.0, 3.5))
    assert one.spent[Activity.IMPORT] == pytest.approx((3.5, 1.75))
    assert one.spent[Activity.SIMULATE] == pytest.approx((3.0, 1.5))


@pytest.mark.parametrize(
    "word",
    [
        said(math.nan, math.nan), said(math.inf, -math.inf), said(-5.0, -1e300),
        said(1e308, 1e308, 1e308, 1e308, 1e308, 1e308), b"", b"x" * 47, b"x" * 100_000,
    ],
)  # fmt: skip
def test_no_word_of_a_worker_changes_the_sum(word: bytes) -> None:
    one = clock(FIT=10.0, SIMULATE=2.0)
    one.count_compiling(word)
    parts = [number for pair in one.spent.values() for number in pair]
    assert all(math.isfinite(number) and number >= 0.0 for number in parts)
    assert sum(parts) == pytest.approx(18.0)


def test_compilation_inside_a_trace_counts_once() -> None:
    meter = Meter()
    meter.request = "fit"
    meter.heard("/jax/core/compile/backend_compile_duration", 0.0)
    meter.heard("/jax/core/compile/jaxpr_trace_duration", 1e6)
    meter.heard("/jax/core/compile/backend_compile_duration", 0.0)
    meter.heard("something else", 5.0)
    trace, compiled = struct.unpack("<2d", meter.tobytes(["fit"]))
    assert (trace, compiled) == (1e6, 0.0)
    assert meter.tobytes(["load"]) == bytes(16)


def test_the_parent_measures_a_worker(
    worker: Callable[..., Worker], case: Case, level: Isolation
) -> None:
    with worker() as one:
        one.fit(BUSY, case.trajectories, case.context)
        one.simulate(case.past_u, case.past_y, case.u)
        one.count_compiling()
    spent = one.spent
    assert set(spent) >= {Activity.START, Activity.IMPORT, Activity.FIT, Activity.SIMULATE}
    assert all(wall > 0 for wall, _ in spent.values())
    assert spent[Activity.START][1] > 0  # the imports of the worker
    assert spent[Activity.FIT][1] > 0
    assert Activity.COMPILE not in spent


def test_compilation_by_jax_is_measured(worker: Callable[..., Worker], case: Case) -> None:
    with worker() as one:
        one.fit(COMPILES, case.trajectories, case.context)
        one.count_compiling()
    assert one.spent[Activity.COMPILE][0] > 0


@pytest.mark.parametrize(
    "answer", ["b''", "b'x' * 10_000_000", "b'\\xff' * 48", "None", "time.sleep(30)"]
)
def test_a_worker_that_lies_about_its_times_is_ignored(
    worker: Callable[..., Worker], case: Case, answer: str
) -> None:
    with worker() as one:
        one.fit(LIES.replace("ANSWER", answer) + GAIN, case.trajectories, case.context)
        one.simulate(case.past_u, case.past_y, case.u)
        before = dict(one.spent)
        one.count_compiling()
    assert {k: v for k, v in one.spent.items() if k is not Activity.START} == {
        k: v for k, v in before.items() if k is not Activity.START
    }
