"""Lessons in a search: what is learned from a run; a run keeps those that it began with."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

import asia
from asia.agents import AGENTS, AgentView, Proposal, RelayAgent, make_runner
from asia.agents.lessons import FIRST_FIT, Lesson, encode_lessons
from asia.agents.library.table import family
from asia.errors import UserError
from asia.ledger import SearchView, Store, open_run, verify
from asia.problem.load import load_problem
from asia.search import (
    Prepared,
    learn_from_run,
    learn_from_runs,
    prepare,
    replay_run,
    search,
    unseal,
)
from tests.unit.search.toy import CRASH, write_problem

KNOWN = (
    Lesson("a", frozenset({"short"}), "arx", FIRST_FIT, 0.5),
    Lesson("b", frozenset({"short"}), "arx", "more starts", None),
)


@dataclass
class Library:
    """Two candidates: the first fit of a family, and a crash; keeps the lessons it was shown."""

    seen: list[tuple[Lesson, ...]] = field(default_factory=list)
    name: str = "scripted"

    def propose(self, view: AgentView) -> Proposal | None:
        self.seen.append(view.lessons)
        if len(view.trials) == 1:
            row = family("arx")
            assert row is not None
            return Proposal(row.trial(view.facts).source(""), "arx", row.label, "made up", "-")
        return Proposal(CRASH, "custom", "crash", "made up", "-")


def made(directory: Path, lessons: tuple[Lesson, ...] | None, experiments: int = 3) -> Prepared:
    problem = load_problem(directory / "toy")
    problem = replace(problem, budget=replace(problem.budget, experiments=experiments))
    return prepare(problem, "scripted", seed=0, runs=directory / "runs", lessons=lessons)


def run(ready: Prepared, agent: Library | None = None) -> SearchView:
    return search(ready, agent or Library(), lambda event, view: None, lambda view: None)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    write_problem(tmp_path / "toy")
    return tmp_path


@pytest.mark.slow
def test_a_run_keeps_its_lessons_and_verifies_and_replays_with_them(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = Library()
    ready = made(directory, KNOWN, 2)
    run(ready, agent)
    other = (Lesson("c", frozenset(), "esn", FIRST_FIT, 1.0),)
    again = Library()
    run(made(directory, other, 3), again)
    assert agent.seen == [KNOWN]
    assert again.seen == [KNOWN]
    started = open_run(ready.directory).view.started
    assert started.lessons is not None
    assert Store(ready.directory / "artifacts").get(started.lessons) == encode_lessons(KNOWN)
    assert verify(ready.directory).artifacts > 1
    asked = Library()
    monkeypatch.setitem(AGENTS, "scripted", lambda: asked)
    assert replay_run(ready.directory, lambda item: None).agrees
    assert asked.seen == [KNOWN] * 2
    (ready.directory / "artifacts" / started.lessons).unlink()
    with pytest.raises(UserError, match=started.lessons[:16]):
        verify(ready.directory)


@pytest.mark.slow
def test_a_run_does_not_change_between_lessons_and_none(directory: Path) -> None:
    run(made(directory, None, 1))
    with pytest.raises(UserError, match="has lessons off, not on"):
        run(made(directory, KNOWN, 1))


@pytest.mark.long
def test_a_run_without_lessons_says_nothing_of_them(directory: Path) -> None:
    agent = Library()
    view = run(made(directory, None, 2), agent)
    assert agent.seen == [()]
    assert view.started.lessons is None


@pytest.mark.long
def test_v_of_the_cross_validation_is_learned_and_no_figure_of_a_test(directory: Path) -> None:
    """The same lessons before and after the test was opened, though the ledger holds it then."""
    ready = made(directory, None)
    view = run(ready)
    (before,) = learn_from_run(ready.directory)
    linear = next(r.outcome for r in view.rungs if r.name == "linear model")
    score = view.experiment(2).score
    assert score is not None
    assert (before.family, before.move) == ("arx", FIRST_FIT)
    assert before.gain == pytest.approx(math.log(linear.value / score.value))
    unseal(ready.directory, process_consent=True)
    assert open_run(ready.directory).view.unsealed is not None
    assert learn_from_run(ready.directory) == (before,)


@pytest.mark.long
def test_what_cannot_be_learned_from_is_left_out_with_a_reason(directory: Path) -> None:
    ready = made(directory, None)
    run(ready)
    whole = ready.directory
    for name in ("cut", "damaged"):
        there = whole.with_name(name)
        there.mkdir()
        for path in whole.rglob("*"):
            if path.is_file():
                target = there / path.relative_to(whole)
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(path.read_bytes())
    lines = (whole / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    (whole.with_name("cut") / "ledger.jsonl").write_bytes(b"".join(lines[:-2]))
    damaged = whole.with_name("damaged") / "ledger.jsonl"
    damaged.write_bytes(damaged.read_bytes().replace(b"made up", b"made it"))
    found = learn_from_runs(whole.parent)
    assert found.learned == (whole.name,)
    assert [name for name, _ in found.left_out] == ["cut", "damaged"]
    assert found.left_out[0][1] == "the search is not finished"
    assert len(found.lessons) == 1


@pytest.mark.slow
def test_every_leg_of_a_relay_has_the_lessons(directory: Path) -> None:
    first, second = Library(name="first"), Library(name="second")
    agent = RelayAgent([make_runner(first, 2), make_runner(second, None)])
    asia.run(directory / "toy", agent=agent, runs=directory / "runs", experiments=3, lessons=KNOWN)
    assert len(first.seen) == len(second.seen) == 1
    assert first.seen == second.seen == [KNOWN]
