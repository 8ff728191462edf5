"""Folds passed over once a candidate is far behind the best: the course stays what it was."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.agents import AgentView, Proposal
from asia.errors import Reason, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.pruning import FoldPruner
from asia.judge.evaluation.results import Evaluation
from asia.judge.executors import make_executor
from asia.judge.scoring.outcome import Failure
from asia.ledger.evidence import cancelled_folds, pruned_folds
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.metrics import find_metric
from asia.search.replay import replay_run
from asia.search.run import prepare, search
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import arx, write_problem

FAR = """
class Model:
    def simulate(self, past_u, past_y, u):
        return 50.0 + u[:, :, :1]


def fit(trajectories, context):
    return Model()
"""
SOURCES = (arx(2), FAR, arx(3))
# Its second fold has other training records, and is long.
FAR_AND_LONG = FAR.replace(
    "def fit(trajectories, context):\n",
    """
import time


def fit(trajectories, context):
    if abs(trajectories[0].u[0, 0] - {first}) > 1e-12:
        time.sleep(50.0)
""",
)


@dataclass(frozen=True)
class Listed:
    """Proposes `SOURCES` in order."""

    name: str = "listed"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal | None:
        place = len(view.proposed) - 1
        if place >= len(SOURCES):
            return None
        return Proposal(SOURCES[place], "listed", f"number {place}", "listed", "listed")


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Source and fold of every fit, as they begin."""
    fits: list[tuple[str, int]] = []
    real: Callable[..., Evaluation] = Evaluator._evaluate_fold  # pyright: ignore[reportPrivateUsage]

    def counted(self: Evaluator, source: str, fold: object, *rest: object) -> Evaluation:
        fits.append((source, getattr(fold, "index", -1)))
        return real(self, source, fold, *rest)

    monkeypatch.setattr(Evaluator, "_evaluate_fold", counted)
    return fits


def go(root: Path, *, stop_folds: bool, parallel: int = 1) -> tuple[SearchView, Path]:
    if not (root / "toy").is_dir():
        write_problem(root / "toy", experiments=4)
    problem = load_problem(root / "toy")
    runs = root / f"runs-{stop_folds}-{parallel}"
    ready = prepare(problem, "listed", seed=0, runs=runs, parallel=parallel, stop_folds=stop_folds)
    executor = make_executor("local:1")
    view = search(ready, Listed(), lambda event, view: None, lambda view: None, executor)
    return view, ready.directory


def decided(e: Experiment) -> tuple[str | None, object]:
    return (e.result.status if e.result else None), e.score or "no score"


@pytest.mark.long
@pytest.mark.parametrize("parallel", [1, 2])
def test_only_the_folds_of_one_far_behind_are_left_out(
    parallel: int, tmp_path: Path, begun: list[tuple[str, int]]
) -> None:
    whole, _ = go(tmp_path, stop_folds=False, parallel=parallel)
    assert [fold for source, fold in begun if source == FAR] == [0, 1]
    begun.clear()
    view, directory = go(tmp_path, stop_folds=True, parallel=parallel)
    assert [fold for source, fold in begun if source == FAR] == [0]
    assert {fold for source, fold in begun if source == arx(3)} == {0, 1}
    for one, other in zip(whole.finished, view.finished, strict=True):
        if other.number != 3:
            assert decided(one) == decided(other)
    far = view.experiment(3)
    assert far.failure is not None
    assert far.failure.reason is Reason.BEHIND
    assert far.result is not None
    assert far.result.status == "discard"
    assert pruned_folds(view) == (1,)
    assert pruned_folds(whole) == ()
    verify(directory)
    assert replay_run(directory, lambda item: None).agrees


@pytest.mark.slow
def test_a_ledger_without_it_has_no_trace_of_it(tmp_path: Path) -> None:
    _, directory = go(tmp_path, stop_folds=False)
    text = (directory / "ledger.jsonl").read_text()
    assert "stop_folds" not in text
    assert '"over"' not in text
    assert not open_run(directory).view.started.stop_folds


@pytest.mark.slow
def test_a_run_goes_on_with_what_it_began_with(tmp_path: Path) -> None:
    _, directory = go(tmp_path, stop_folds=False)
    problem = load_problem(tmp_path / "toy")
    again = prepare(problem, "listed", seed=0, runs=directory.parent, stop_folds=True)
    with pytest.raises(UserError, match="--stop-folds off, not on"):
        search(again, Listed(), lambda event, view: None, lambda view: None)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"early_stopping": "validation"}, "validation early stopping"),
        ({"ladder": 0.01}, "a ladder"),
    ],
)
def test_refused_where_there_is_no_bound(
    changed: dict[str, Any], words: str, tmp_path: Path
) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    problem = replace(problem, protocol=replace(problem.protocol, **changed))
    with pytest.raises(UserError, match=words):
        prepare(problem, "listed", seed=0, runs=tmp_path / "runs", stop_folds=True)


@pytest.mark.parametrize("changed", [{"direction": "higher"}, {"best": -1.0}])
def test_refused_for_a_metric_without_a_bound(
    changed: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other = replace(find_metric("rmse"), **changed)
    monkeypatch.setattr("asia.search.pending.find_metric", lambda name: other)
    problem = load_problem(write_problem(tmp_path / "toy"))
    with pytest.raises(UserError, match="no lower bound"):
        prepare(problem, "listed", seed=0, runs=tmp_path / "runs", stop_folds=True)


@given(st.lists(st.floats(0.0, 10.0), min_size=2, max_size=6), st.floats(0.0, 10.0), st.data())
def test_the_bound_does_not_depend_on_which_fold_ends_first(
    parts: list[float], over: float, data: st.DataObject
) -> None:
    order = data.draw(st.permutations(range(len(parts))))
    one, other = (fed(parts, over, way) for way in (range(len(parts)), order))
    assert one == other
    if one is not None:
        assert sum(parts) / len(parts) > over * (1 - 1e-12)
        assert one.fold is not None
        assert one.fold < len(parts)


def fed(parts: list[float], over: float, order: object) -> Failure | None:
    bound = FoldPruner(len(parts), over)
    for place in order:  # type: ignore[attr-defined]
        bound._parts[place] = parts[place]  # pyright: ignore[reportPrivateUsage]
    return bound.failure()


@dataclass(frozen=True)
class Two:
    """Proposes two candidates."""

    sources: tuple[str, str]
    name: str = "listed"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal | None:
        place = len(view.proposed) - 1
        if place >= 2:
            return None
        return Proposal(self.sources[place], "listed", f"number {place}", "listed", "listed")


@pytest.mark.long
@pytest.mark.parametrize("parallel", [1, 2])
def test_a_fold_that_runs_is_ended_and_said(parallel: int, tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path / "toy", experiments=3))
    first = make_folds(problem.train, problem.protocol)[0].train[0].u[0, 0]
    agent = Two((arx(2), FAR_AND_LONG.replace("{first}", repr(float(first)))))
    ready = prepare(
        problem, "listed", seed=0, runs=tmp_path / "runs", parallel=parallel, stop_folds=True
    )
    view = search(ready, agent, lambda e, v: None, lambda v: None, make_executor("local:2"))
    result = view.experiment(3).result
    assert result is not None
    assert result.status == "discard"
    assert result.seconds < 40.0
    assert (result.ended_folds, cancelled_folds(view)) == (1, 1)
    done = command_line("status", ready.directory.name, "--runs", tmp_path / "runs")
    assert "1 pruned, 1 of them ended while they ran, in 1 experiments" in done.out
    verify(ready.directory)
    assert replay_run(ready.directory, lambda item: None).agrees
