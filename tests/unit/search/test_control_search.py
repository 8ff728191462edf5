"""A search for a controller: from the first experiment to the sealed scenarios."""

from pathlib import Path

import pytest

import asia
from asia.errors import UserError
from asia.judge.evaluation import references
from asia.ledger import events
from asia.ledger.verification import verify
from asia.problem.load import load_lock, load_problem
from asia.report.page.page import write_page
from asia.search.replay import replay_run
from asia.search.run import LOCK, make_evaluator, prepare
from asia.search.scores import ScoreCheck
from asia.search.settings import SearchSettings
from asia.search.unsealing import unseal
from tests.unit.problem.small_control import PI, write_control_problem

from .toy import Scripted

FASTER = PI.replace("Controller(1.0)", "Controller(2.0)")
WILD = PI.replace("return self.integral + self.k * error", "return 3.0 * (r[0] < y[0])")


@pytest.mark.slow
def test_a_search_runs_goes_on_replays_and_is_unsealed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = {"inputs held": references.CONTROLLERS["inputs held"]}
    monkeypatch.setattr(references, "CONTROLLERS", held)
    folder, runs = write_control_problem(tmp_path / "lag"), tmp_path / "runs"
    agent = Scripted((FASTER, WILD))
    first = asia.run(folder, agent=agent, runs=runs, experiments=2)
    # A larger budget goes on in the same run, with the same identified models.
    run = asia.run(folder, agent=agent, runs=runs, experiments=3)
    assert run.directory == first.directory
    values = {e.number: e.score.value for e in run.view.finished if e.score is not None}
    assert set(values) == {1, 2, 3}
    assert values[3] > 2 * max(values[1], values[2])
    (reference,) = run.view.references
    assert reference.name == "inputs held"
    refitted = run.view.refitted
    assert refitted is not None
    assert (refitted.use, refitted.stack) == ("refit", None)
    found = verify(run.directory, check=ScoreCheck(run.directory))
    assert found
    report = replay_run(run.directory, lambda item: None)
    assert all(item.agrees for item in report.items)
    opened = unseal(run.directory).record
    assert isinstance(opened.refit, events.TestedModel)
    assert not isinstance(opened.ensemble, events.TestedModel)
    page = write_page(run.directory).read_text("utf-8")
    assert "Closed loop" in page
    assert "inputs held" in page
    assert "set point" in page
    # What needs a model says so.
    with pytest.raises(UserError, match="searched for a controller"):
        make_evaluator(load_lock(run.directory / LOCK), run.view)


def test_what_knows_models_only_is_refused(tmp_path: Path) -> None:
    problem = load_problem(write_control_problem(tmp_path / "lag"))
    with pytest.raises(UserError, match="agent bayes proposes models"):
        prepare(problem, "bayes", seed=0, runs=tmp_path / "runs")
    with pytest.raises(UserError, match="without scores"):
        SearchSettings(early_stopping="validation").applied(problem)
