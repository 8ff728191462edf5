"""Controllers that the expert proposes, and what a language model reads."""

from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents.control import propose_controller
from asia.agents.llm.prompt import briefing
from asia.agents.view import AgentView, Trial
from asia.candidate import check_source, source_digest
from asia.judge.evaluation.references import CONTROLLER, CONTROLLERS
from asia.problem.load import load_problem
from asia.search.agent_views import problem_facts
from tests.unit.problem.small_control import write_control_problem


def trial(number: int, source: str, family: str, value: float) -> Trial:
    return Trial(
        number=number, parent=None, phase="explore", family=family, title="", hypothesis="",
        expected="", source=source, status="keep", value=value, folds=(value,), failure=None,
        diagnostics=(),
    )  # fmt: skip


def view_of(folder: Path, trials: tuple[Trial, ...]) -> AgentView:
    known = {source_digest(t.source) for t in trials}
    return AgentView(
        facts=problem_facts(load_problem(folder)), seed=0, phase="explore", trials=trials,
        remaining=20, is_known=lambda source: source_digest(source) in known,
    )  # fmt: skip


def test_the_expert_climbs_a_ladder_then_changes_the_best(tmp_path: Path) -> None:
    folder = write_control_problem(tmp_path)
    view = view_of(folder, (trial(1, CONTROLLER, "baseline", 1.0),))
    families: list[str] = []
    while len(view.trials) < 12:
        proposal = propose_controller(view)
        assert proposal is not None
        check_source(proposal.source)
        assert not view.is_known(proposal.source)
        families.append(proposal.family)
        # The regulator is the best of the ladder.
        value = 0.5 if proposal.family == "lqr" else 0.8
        number = len(view.trials) + 1
        view = view_of(
            folder, (*view.trials, trial(number, proposal.source, proposal.family, value))
        )
    # The first candidate of every search is the first of the ladder.
    assert families[:3] == ["lqr", "scheduled pid", "mpc"]
    assert families[3] == "lqr with residual"
    assert len({t.source for t in view.trials}) == len(view.trials)


def test_the_expert_ends_when_nothing_is_left(tmp_path: Path) -> None:
    folder, trials = write_control_problem(tmp_path), tuple[Trial, ...]()
    for number in range(1, 200):
        proposal = propose_controller(view_of(folder, trials))
        if proposal is None:
            break
        trials = (*trials, trial(number, proposal.source, proposal.family, 1.0 / number))
    else:
        pytest.fail("it never ends")


def test_reference_controllers_can_be_candidates() -> None:
    for source in (CONTROLLER, *CONTROLLERS.values()):
        check_source(source)


def test_the_briefing_tells_a_controllers_contract_and_nothing_of_the_plant(
    tmp_path: Path,
) -> None:
    folder = write_control_problem(tmp_path)
    facts = replace(problem_facts(load_problem(folder)), description="A lag.")
    text = briefing(facts)
    assert "design(models, context)" in text
    assert "input u: 0 to 3, at most 1 in a second, 1 at first" in text
    assert "set point of y: steps between 1 and 4" in text
    for secret in ("load", "plant.py", "params"):
        assert secret not in text
