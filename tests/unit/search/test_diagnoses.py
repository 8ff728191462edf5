"""A check of the evidence leads the expert to the move that answers it, from end to end."""

from pathlib import Path

import numpy as np
import pytest

from asia.agents import AgentView, Proposal
from asia.agents.expert.agent import ExpertAgent
from asia.judge.evaluation.references import LINEAR
from asia.problem.load import load_problem
from asia.search.run import prepare, search

from .toy import write_problem


@pytest.mark.long
def test_a_saturated_drive_gets_a_saturation_next(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "drive", experiments=2, test=False)
    settings = problem / "problem.toml"
    settings.write_text(settings.read_text().replace("fit_seconds = 20", "fit_seconds = 120"))
    rng = np.random.default_rng(5)
    u = np.repeat(3.0 * rng.normal(size=60), 15)
    v, y = np.clip(u, -1.5, 2.0), np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = 1.6 * y[k - 1] - 0.7 * y[k - 2] + 0.1 * v[k - 1]
    table = np.stack([u, y + 0.01 * rng.normal(size=len(u))], axis=1)
    np.savetxt(problem / "train.csv", table, delimiter=",", header="u,y", comments="")
    (problem / "baseline.py").write_text(LINEAR)
    seen: list[AgentView] = []

    class Spy(ExpertAgent):
        def propose(self, view: AgentView) -> Proposal | None:
            seen.append(view)
            return super().propose(view)

    ready = prepare(load_problem(problem), Spy.name, seed=0, runs=tmp_path / "runs")
    found = search(ready, Spy(), lambda event, view: None, lambda view: None).experiment(2)
    name, share = seen[0].trials[0].diagnoses[0]
    assert name == "amplitude"
    assert 0.1 < share <= 1.0
    assert found.proposed.title.endswith("saturated inputs")
    assert found.score is not None
    linear = seen[0].trials[0].value
    assert linear is not None
    assert found.score.value < 0.3 * linear
