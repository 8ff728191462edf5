"""The view of an agent over a search that goes on."""

from pathlib import Path

import pytest

from asia.ledger.artifacts import Store
from asia.ledger.run import open_run
from asia.presentation.exports import journal
from asia.problem.load import load_problem
from asia.search.agent_views import KnownTrials, agent_view, problem_facts

GOLDEN = Path(__file__).parents[3] / "golden/0.1.0"


def test_artifacts_of_known_trials_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    run = open_run(GOLDEN / "runs/finished")
    facts = problem_facts(load_problem(GOLDEN / "problem"))
    known = KnownTrials(run.store)
    first = agent_view(facts, run.view, run.store, known)
    assert len(first.trials) >= 3
    monkeypatch.setattr(Store, "get", lambda store, name: pytest.fail("it was read again"))
    again = [known.trial(e) for e in run.view.finished]
    assert [t.source for t in again] == [t.source for t in first.trials]
    assert [t.curves for t in again] == [t.curves for t in first.trials]


def test_the_journal_names_the_experiment_that_followed() -> None:
    view = open_run(GOLDEN / "runs/finished").view
    text = journal(view)
    for before, after in zip(view.finished, view.finished[1:], strict=False):
        entry = text.split(f"## Experiment {before.number}:")[1]
        assert f"- **Next:** {after.proposed.title}\n" in entry.split("## Experiment")[0]
    assert text.count("- **Next:** none yet") == 1
