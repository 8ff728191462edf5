"""A run goes on with the layers it began with."""

from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.judge.sandbox import level
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.problem.load import load_problem
from asia.search.run import prepare, search

from .toy import Scripted, arx, write_problem


@pytest.mark.slow
@pytest.mark.skipif(probe().level is not Isolation.NAMESPACE, reason="the level namespace fails")
def test_a_run_that_would_go_on_with_fewer_layers_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = load_problem(write_problem(tmp_path / "toy"))
    agent = Scripted((arx(1),))

    def go(experiments: int) -> int:
        budget = replace(problem.budget, experiments=experiments)
        ready = prepare(replace(problem, budget=budget), agent.name, seed=0, runs=tmp_path / "runs")
        view = search(ready, agent, lambda event, view: None, lambda view: None)
        return len(view.finished)

    assert go(1) == 1
    monkeypatch.setattr(level, "missing_layers", lambda: {"landlock": "taken away"})
    with pytest.raises(
        UserError, match=r"a layer .* not available \(landlock\): continue it where it started"
    ):
        go(2)
    monkeypatch.undo()
    assert go(2) == 2
