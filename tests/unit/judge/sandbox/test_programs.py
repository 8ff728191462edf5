"""Compiled programs that workers share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.agents.library.registry import all_families
from asia.candidate import library_only
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.programs import ProgramStore
from asia.judge.sandbox.types import Isolation
from asia.judge.sandbox.worker.wire import packed_programs, unpacked_programs
from asia.judge.sandbox.worker.worker import Worker
from asia.problem.load import load_problem
from asia.search.agent_views import problem_facts
from tests.unit.judge.sandbox.conftest import Case


@pytest.fixture
def level() -> Isolation:
    """The strongest one: none of this depends on the layers."""
    return probe().level


OWN = """
from asia.models import neural_ss
from asia.models.methods import LevenbergMarquardt

def fit(trajectories, context):
    model = neural_ss.build(neural_ss.Config(order=1, hidden=2), context)
    return neural_ss.train(model, trajectories, context, LevenbergMarquardt(2))
"""
# Puts a forged program in place of each that it finds.
FORGER = f"""
import gc
{OWN}
def forge():
    for found in gc.get_objects():
        if type(found).__name__ == "Programs":
            for key in list(found.made):
                found.made[key] = b"forged"
            found.made["jit_planted-" + 64 * "0"] = b"forged"

honest = fit

def fit(trajectories, context):
    model = honest(trajectories, context)
    forge()
    return model
"""


@pytest.mark.slow
def test_a_program_is_compiled_once_and_gives_the_same_model(
    worker: Callable[..., Worker], case: Case
) -> None:
    store, found, made = ProgramStore(), list[np.ndarray](), list[dict[str, bytes]]()
    for _ in range(2):
        with worker() as one:
            one.fit(OWN, case.trajectories, case.context, programs=store)
            made.append(unpacked_programs(one._reply("programs", (), 1 << 23)))
            found.append(one.simulate(case.past_u, case.past_y, case.u))
    assert {key.partition("-")[0] for key in made[0]} >= {"selection", "linear"}
    assert len(made[0]) > 2
    assert not made[1]
    np.testing.assert_array_equal(found[0], found[1])


def test_no_candidate_plants_a_program(worker: Callable[..., Worker], case: Case) -> None:
    store = ProgramStore()
    with worker() as one:
        one.fit(FORGER, case.trajectories, case.context, programs=store)
        offered = unpacked_programs(one._reply("programs", (), 1 << 23))
    assert b"forged" in offered.values()
    assert all(store.get(key) is None for key in offered)


def test_the_library_alone() -> None:
    problem = load_problem("two_tanks_sim")
    facts = problem_facts(problem)
    assert library_only(problem.baseline)
    for family in all_families():
        source = family.trial(facts).source(family.label)
        # A simulator is code of the user's own.
        assert library_only(source) == (family.name != "simulator"), family.name


@pytest.mark.parametrize(
    "change",
    [
        "import os",
        "from os import system",
        "from asia.models import _files",
        "from asia import load_run",
        "neural_ss.np.load('x')",
        "LevenbergMarquardt = fit",
        "[fit for fit in ()]",
        "neural_ss.Config(order=eval)",
        "neural_ss.Config(**{})",
        "neural_ss.fit_states()",
        "@fit\ndef other(): return 1",
        "def other(x=fit()): return 1",
        "def other(x: fit()): return 1",
        "def other(*, x: fit()): return 1",
        "def other(x: fit(), /): return 1",
        "def other(*x: fit()): return 1",
        "def other(**x: fit()): return 1",
        "def other() -> fit(): return 1",
        "def other(neural_ss): return neural_ss.train()",
        "def other():\n    def inner(): return 1\n    return 1",
        "def other():\n    from asia.models import linear\n    return 1",
        "from asia.models import *",
        "from asia.models import linear as __builtins__",
        "__builtins__ = {}",
        "neural_ss.Any()",
        "from asia.models.neural_ss import Config",
        "from asia.candidate import Context as Sequence",
        "from asia.candidate import Context, library_only",
        "from collections.abc import Callable",
        "from asia.problem import Trajectory\nTrajectory = 1",
        "def other(x: neural_ss._x): return 1",
        "def other(x: neural_ss.a.b): return 1",
        "def other(x: Sequence[fit()]): return 1",
        "def other(x: Context[1]): return 1",
        "def other(x, /, y): return 1",
        "neural_ss.Config(order=fit)",
        "class Other: pass",
        "fit.train = 1",
        "f'{fit}'",
        "'a'.join('b')",
        "lambda: 0",
    ],
)
def test_other_code_than_the_librarys(change: str) -> None:
    assert library_only(OWN)
    assert not library_only(f"{OWN}\n{change}\n")


@given(
    st.dictionaries(st.from_regex(r"[\w.-]{1,40}", fullmatch=True).filter(str.isascii), st.binary())
)
def test_programs_travel_unchanged(programs: dict[str, bytes]) -> None:
    assert unpacked_programs(packed_programs(programs)) == programs


@given(st.binary(max_size=200))
def test_other_bytes_are_refused_or_read(data: bytes) -> None:
    try:
        found = unpacked_programs(data)
    except ValueError:
        return
    assert sum(16 + len(key) + len(value) for key, value in found.items()) <= len(data)


def test_a_store_keeps_those_used_last() -> None:
    store = ProgramStore(most_bytes=10)
    store.add({"a": b"12345", "b": b"12345"})
    assert store.get("a") == b"12345"
    store.add({"c": b"1"})
    assert [store.get(key) for key in "abc"] == [b"12345", None, b"1"]
