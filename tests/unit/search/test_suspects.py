"""Cheats that isolation cannot stop never become the incumbent."""

import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest

from asia.errors import Reason
from asia.judge.evaluation import evaluator as evaluator_module
from asia.judge.evaluation import workers as workers_module
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.search.replay import replay_run
from asia.search.run import make_evaluator, prepare, search

from .toy import ARX, Scripted, arx, write_problem

# What an agent may do who has read the records: answers by input, in some hundred bytes.
LOOK_UP = """
import zlib

ANSWERS = {answers}


class Looking(Model):
    def simulate(self, past_u, past_y, u):
        y = super().simulate(past_u, past_y, u)
        for b in range(len(u)):
            found = ANSWERS.get(zlib.crc32(u[b].tobytes()))
            if found is not None:
                y[b, :, 0] = np.interp(np.arange(len(y[b])), 2 * np.arange(len(found)), found)
        return y


def fit(trajectories, context):
    return Looking(train(trajectories, context).weights)
"""


def looking(problem: Path) -> str:
    """Candidate that answers each fold from a table, thinned to pass the source check."""
    loaded = load_problem(problem)
    answers = {
        zlib.crc32(block.u.tobytes()): np.round(block.y[::2, 0], 1).tolist()
        for fold in make_folds(loaded.train, loaded.protocol)
        for block in fold.held_out
    }
    honest = ARX.replace("{order}", "1").replace("def fit(", "def train(")
    return honest + LOOK_UP.replace("{answers}", repr(answers))


def go(problem: Path, runs: Path, *sources: str) -> SearchView:
    agent = Scripted(sources)
    ready = prepare(load_problem(problem), agent.name, seed=0, runs=runs)
    return search(ready, agent, lambda event, view: None, lambda view: None)


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", experiments=3)


def cheated(root: Path) -> tuple[SearchView, Path]:
    """A search with a cheat, an honest candidate and the same cheat in other words."""
    problem = root / "toy"
    if not problem.is_dir():
        write_problem(problem)
    cheat = looking(problem)
    view = go(problem, root / "runs", cheat, arx(2), f'"""Honest."""\n# now really\n{cheat}')
    return view, root / "runs" / "toy-scripted-s0"


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> tuple[SearchView, Path]:
    return cheated(tmp_path_factory.mktemp("cheated"))


@pytest.mark.slow
def test_a_table_of_answers_is_recorded_and_never_kept(once: tuple[SearchView, Path]) -> None:
    view, directory = once
    failure = view.experiment(2).failure
    assert failure is not None
    assert failure.reason is Reason.SUSPECT
    assert "perturbation" in failure.detail
    assert "causal" in failure.advice
    results = [e.result for e in view.finished if e.result]
    assert [r.status for r in results] == ["keep", "invalid", "keep", "invalid"]
    # What its training side shows is told as of any other.
    assert [len(r.folds) for r in results[:3]] == [2, 2, 2]
    # In other words it is answered from the ledger.
    assert results[3].duplicate_of == 2
    assert results[3].outcome == failure
    verify(directory)
    assert "invalid" in (directory / "results.tsv").read_text()
    assert "the simulation jump" in (directory / "search_journal.md").read_text()
    assert replay_run(directory, lambda item: None).agrees


@pytest.mark.slow
def test_killed_before_the_verdict_it_comes_to_the_same(
    once: tuple[SearchView, Path], tmp_path: Path
) -> None:
    first, directory = once
    shutil.copytree(directory.parents[1], tmp_path, dirs_exist_ok=True)
    ledger = tmp_path / "runs" / directory.name / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    place = next(i for i, line in enumerate(lines) if b'"reason":"suspect"' in line)
    ledger.write_bytes(b"".join(lines[:place]))
    again, _ = cheated(tmp_path)
    assert [e.result.outcome for e in again.finished if e.result] == [
        e.result.outcome for e in first.finished if e.result
    ]
    assert len(again.experiments) == 4


def test_a_source_that_is_too_long_starts_no_worker(
    finished_once: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, directory = finished_once / "toy", finished_once / "runs" / "toy-scripted-s0"
    record = load_problem(problem).train[0]
    source = f"TABLE = {np.tile(record.y[:, 0], 20).tolist()}\n{arx(2)}"
    started: list[object] = []
    opener = workers_module.open_worker
    monkeypatch.setattr(workers_module, "open_worker", lambda *a: started.append(a) or opener(*a))
    judge = make_evaluator(load_problem(problem), open_run(directory).view)
    outcome = judge.evaluate(source).outcome
    assert getattr(outcome, "reason", None) is Reason.SOURCE_SIZE
    assert started == []


@pytest.mark.long
def test_what_is_checked_is_another_in_every_run(
    problem: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[object] = []
    check = evaluator_module.suspicions
    monkeypatch.setattr(
        evaluator_module,
        "suspicions",
        lambda *a, **named: drawn.append(named["seed"]) or check(*a, **named),
    )
    for runs in ("one", "another"):
        go(problem, tmp_path / runs, arx(2))
    half = len(drawn) // 2
    assert half > 0
    assert set(drawn[:half]).isdisjoint(drawn[half:])


@pytest.mark.long
def test_seeds_are_the_evaluators(problem: Path, tmp_path: Path) -> None:
    """The same for every candidate on a fold: another source is no other luck."""
    telling = arx(1).replace("context.log(1,", "context.log(context.seed,")
    view = go(problem, tmp_path / "runs", telling, telling.replace("n = 1", "n = 2"))
    store = open_run(tmp_path / "runs" / "toy-scripted-s0").store
    seeds = [
        [int(np.frombuffer(store.get(fold.curve), "<f8")[0]) for fold in e.result.folds]
        for e in view.finished[1:]
        if e.result
    ]
    assert seeds[0] == seeds[1]
    assert len(set(seeds[0])) == 2
