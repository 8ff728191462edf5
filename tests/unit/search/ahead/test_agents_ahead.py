"""The agents of a search with several experiments in flight: its course replays."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents import Agent, make_agent
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator
from asia.judge.scoring.outcome import Score
from asia.ledger.events import Proposed
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.guard import Gate
from asia.search.replay import replay_run
from asia.search.run import prepare, search
from tests.unit.search.toy import arx, write_problem


@pytest.fixture(scope="module")
def quick() -> Iterator[None]:
    """Every candidate has the folds of one fit, and a V that its source decides."""
    known: list[Evaluation] = []
    real: Callable[..., Evaluation] = Evaluator.evaluate

    def evaluate(self: Evaluator, source: str, start: int = 0) -> Evaluation:
        if not known:
            known.append(real(self, arx(2)))
        outcome = known[0].outcome
        assert isinstance(outcome, Score)
        number = int.from_bytes(hashlib.sha256(source.encode()).digest()[:4], "big")
        return replace(known[0], outcome=replace(outcome, value=0.1 + number / 2**32))

    def refit(self: Evaluator, source: str, models: object = ()) -> None:
        raise CandidateError(Reason.CRASH, "made up")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "evaluate", evaluate)
        # Nothing is compared before.
        patch.setattr(EvaluationData, "inner_folds", ())
        patch.setattr(Evaluator, "objection", lambda self, source, folds: None)
        # Guard records say nothing of a score that was made up.
        patch.setattr(Gate, "confirm", lambda self, source, evaluation, view: None)
        patch.setattr(Evaluator, "refit", refit)
        yield


def go(root: Path, agent: Agent, parallel: int) -> tuple[SearchView, Path]:
    if not (root / "toy").is_dir():
        write_problem(root / "toy", experiments=8)
    problem = load_problem(root / "toy")
    problem = replace(problem, budget=replace(problem.budget, patience=99))
    runs = root / f"runs{parallel}"
    ready = prepare(problem, agent.name, seed=0, runs=runs, parallel=parallel)
    return search(ready, agent, lambda event, view: None, lambda view: None), ready.directory


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "name",
    ["expert", *(pytest.param(name, marks=pytest.mark.long) for name in ("random", "bayes"))],
)
def test_a_search_with_experiments_in_flight_replays(name: str, tmp_path: Path) -> None:
    view, directory = go(tmp_path, make_agent(name), 3)
    assert len({e.proposed.digest for e in view.finished}) == 8
    report = replay_run(directory, lambda item: None)
    assert report.agrees
    assert sum(item.proposal == "same" for item in report.items) >= 8
    lines = open_run(directory).lines
    ahead = [line.event for line in lines[:8] if isinstance(line.event, Proposed)]
    assert len(ahead) >= 3


@pytest.mark.usefixtures("quick")
def test_random_proposes_what_it_does_one_at_a_time(tmp_path: Path) -> None:
    serial, _ = go(tmp_path, make_agent("random"), 1)
    ahead, _ = go(tmp_path, make_agent("random"), 3)
    for one, other in zip(serial.finished, ahead.finished, strict=True):
        assert one.proposed == other.proposed
        assert one.result is not None
        assert other.result is not None
        assert one.result.outcome == other.result.outcome
        assert one.result.status == other.result.status
