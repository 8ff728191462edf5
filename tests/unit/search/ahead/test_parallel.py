"""Several experiments in flight: the course of a search, and what a kill leaves."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from asia.agents import AgentView, Proposal
from asia.errors import UserError
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.executors import LocalExecutor
from asia.judge.scoring.outcome import Score
from asia.ledger.events import Event, Landed, Proposed
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import Experiment, SearchView
from asia.problem.load import load_problem
from asia.search.pending import PendingFits
from asia.search.replay import replay_run
from asia.search.run import Prepared, prepare, search
from asia.search.steering import Steering
from tests.unit.search.toy import CRASH, arx, write_problem

SOURCES = (arx(2), CRASH, arx(3), arx(2) + "# a twin\n", arx(3).replace("1, float", "2, float"))


@dataclass(frozen=True)
class Ahead:
    """Proposes the given sources in order, whatever runs, and remembers what it saw."""

    sources: tuple[str, ...]
    seen: list[tuple[int, int]]
    name: str = "scripted"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal | None:
        self.seen.append((len(view.trials), len(view.running)))
        index = len(view.proposed) - 1
        if index >= len(self.sources):
            return None
        return Proposal(self.sources[index], "scripted", f"number {index}", "scripted", "scripted")


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", experiments=6)


def prepared(problem: Path, runs: Path, parallel: int, **settings: bool) -> Prepared:
    loaded = load_problem(problem)
    return prepare(loaded, "scripted", seed=0, runs=runs, parallel=parallel, **settings)


def go(
    problem: Path,
    runs: Path,
    parallel: int,
    sources: tuple[str, ...] = SOURCES,
    on_event: Callable[[Event, SearchView], None] = lambda event, view: None,
) -> SearchView:
    ready = prepared(problem, runs, parallel)
    agent = Ahead(sources, [])
    return search(ready, agent, on_event, lambda view: None, LocalExecutor(2))


def course(directory: Path) -> list[object]:
    """The ledger without measured times, first fits out of turn and what names the run."""
    found: list[object] = []
    for line in open_run(directory).lines:
        event = line.event
        if not isinstance(event, Landed) and event.event not in ("started", "refitted"):
            measured: dict[str, object] = {
                k: 0.0 for k in ("seconds", "elapsed") if hasattr(event, k)
            }
            outcome = getattr(event, "outcome", None)
            if isinstance(outcome, Score):
                timeless = (replace(f, fit_seconds=0.0, findings=None) for f in outcome.folds)
                measured["outcome"] = replace(outcome, folds=tuple(timeless))
            found.append(replace(event, **measured))
    return found


def delayed(monkeypatch: pytest.MonkeyPatch, delays: dict[str, float]) -> list[str]:
    """Sources as they are evaluated first, each after its delay."""
    begun: list[str] = []
    evaluate = Evaluator.evaluate

    def late(self: Evaluator, source: str, start: int = 0) -> Evaluation:
        if start == 0:
            begun.append(source)
            time.sleep(delays.get(source, 0.0))
        return evaluate(self, source, start)

    monkeypatch.setattr(Evaluator, "evaluate", late)
    return begun


def test_one_at_a_time_leaves_no_trace_in_the_ledger(finished_once: Path) -> None:
    text = (finished_once / "runs" / "toy-scripted-s0" / "ledger.jsonl").read_text()
    for word in ('"parallel"', '"elapsed"', '"landed"'):
        assert word not in text


@pytest.mark.long
def test_the_course_does_not_depend_on_who_ends_first(
    problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    courses: list[list[object]] = []
    for name, delays in (("a", {arx(1): 1.0}), ("b", {arx(2): 1.0})):
        with monkeypatch.context() as patch:
            delayed(patch, delays)
            go(problem, tmp_path / name, 3)
        directory = tmp_path / name / "toy-scripted-s0"
        verify(directory)
        courses.append(course(directory))
        lines = open_run(directory).lines
        assert any(isinstance(line.event, Landed) for line in lines)
    assert courses[0] == courses[1]


@pytest.mark.long
def test_results_are_those_of_one_at_a_time(problem: Path, tmp_path: Path) -> None:
    serial, ahead = go(problem, tmp_path / "serial", 1), go(problem, tmp_path / "ahead", 3)
    for one, other in zip(serial.finished, ahead.finished, strict=True):
        assert one.result is not None
        assert other.result is not None
        assert one.result.outcome == other.result.outcome
        assert one.result.status == other.result.status
    assert ahead.experiment(5).result is not None
    report = replay_run(tmp_path / "ahead" / "toy-scripted-s0", lambda item: None)
    assert report.agrees
    assert len(report.items) > 6


@pytest.mark.slow
def test_a_proposal_sees_all_but_the_last_results(problem: Path, tmp_path: Path) -> None:
    ready, agent = prepared(problem, tmp_path / "runs", 3), Ahead(SOURCES, [])
    search(ready, agent, lambda event, view: None, lambda view: None)
    assert agent.seen == [(0, 1), (0, 2), (1, 2), (2, 2), (3, 2)]


@pytest.mark.slow
def test_a_twin_is_not_evaluated_while_the_first_one_runs(
    problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = delayed(monkeypatch, {})
    twins = arx(2), arx(2) + "# a twin\n"
    view = go(problem, tmp_path / "runs", 4, (*twins, arx(3)))
    assert [begun.count(source) for source in (arx(1), *twins, arx(3))] == [1, 1, 0, 1]
    twin = view.experiment(3).result
    assert twin is not None
    assert twin.duplicate_of == 2
    assert view.stopped is not None
    assert view.stopped.reason == "exhausted"


class KilledError(BaseException):
    """In place of a signal."""


@pytest.mark.slow
def test_a_killed_search_loses_nothing_and_repeats_nothing(
    problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = (arx(2), arx(3))
    go(problem, tmp_path / "undisturbed", 3, sources)
    begun = delayed(monkeypatch, {arx(1): 6.0})
    landed = threading.Semaphore(0)

    def told(event: Event, view: SearchView) -> None:
        if isinstance(event, Landed):
            landed.release()

    def cut_off(flights: PendingFits, experiment: Experiment) -> None:
        assert experiment.number == 1
        assert landed.acquire(timeout=60.0)
        assert landed.acquire(timeout=60.0)
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(PendingFits, "take", cut_off)
        with pytest.raises(KilledError):
            go(problem, tmp_path / "runs", 3, sources, told)
    directory = tmp_path / "runs" / "toy-scripted-s0"
    cut = open_run(directory).view
    assert [e.number for e in cut.running] == [1, 2, 3]
    assert [e.number for e in cut.running if e.landed is not None] == [2, 3]
    go(problem, tmp_path / "runs", 3, sources)
    # The first was cut off in the middle, the others had ended.
    assert begun.count(arx(1)) == 2
    assert begun.count(arx(2)) == 1
    assert begun.count(arx(3)) == 1
    assert course(directory) == course(tmp_path / "undisturbed" / "toy-scripted-s0")
    assert replay_run(directory, lambda item: None).agrees


@pytest.mark.long
def test_a_person_who_stops_gets_what_was_begun(problem: Path, tmp_path: Path) -> None:
    def stop(event: Event, view: SearchView) -> None:
        if isinstance(event, Proposed) and event.experiment == 2:
            Steering(tmp_path / "runs" / "toy-scripted-s0").stop()

    view = go(problem, tmp_path / "runs", 3, on_event=stop)
    assert view.stopped is not None
    assert view.stopped.reason == "user"
    assert not view.running
    assert len(view.finished) == 2


@pytest.mark.slow
def test_what_cannot_run_ahead_is_refused(problem: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="strict isolation runs the workers sequentially"):
        prepared(problem, tmp_path / "runs", 2, isolation_strict=True)
    with pytest.raises(UserError, match="expected at least 1"):
        prepared(problem, tmp_path / "runs", 0)
    ready = prepared(problem, tmp_path / "runs", 2)
    blind = Ahead(SOURCES, [], proposes_ahead=False)
    with pytest.raises(UserError, match="proposes one experiment at a time"):
        search(ready, blind, lambda event, view: None, lambda view: None)
    assert not (tmp_path / "runs" / "toy-scripted-s0" / "ledger.jsonl").exists()
    go(problem, tmp_path / "runs", 2, ())
    with pytest.raises(UserError, match="has --parallel 2, not 3"):
        go(problem, tmp_path / "runs", 3)
