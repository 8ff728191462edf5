"""The expert's decisions on made-up evidence."""

from dataclasses import replace

import numpy as np

from asia.agents import AgentView, ExpertAgent, Facts, Proposal, Trial
from asia.agents._evidence import overfit, plateau_share
from asia.candidate import source_digest
from asia.ledger import Diagnostics
from asia.problem import ParameterRange, Physics, Signal, Trajectory

CLEAN = Diagnostics(0.1, 0.0, 0.1, 0.05, 1.0, 1.0, 1.0, 0.05)


def facts(*, physics: bool) -> Facts:
    rng = np.random.default_rng(0)
    record = Trajectory(rng.normal(size=200), rng.normal(size=200), 1.0)
    equations = Physics(
        states=("x1", "x2"),
        dynamics={"x1": "-a*x1 + u", "x2": "x1 - a*x2"},
        parameters={"a": ParameterRange(0.01, 1.0)},
        observation={"y": "x2"},
    )
    return Facts(
        "", (Signal("u"),), (Signal("y"),), 1.0, (record,), 5, equations if physics else None
    )


def trial(proposal: Proposal, number: int, value: float, evidence: Diagnostics = CLEAN) -> Trial:
    return Trial(
        number, proposal.parent, "explore", proposal.family, proposal.title, proposal.hypothesis,
        proposal.expected, proposal.source, "keep", value, (value, value), None,
        (evidence, evidence),
    )  # fmt: skip


def view(known: Facts, trials: tuple[Trial, ...], phase: str) -> AgentView:
    tried = {source_digest(t.source) for t in trials}
    return AgentView(
        known,
        0,
        phase,
        trials,
        10,
        lambda s: source_digest(s) in tried,  # type: ignore[arg-type]
    )


def climb(known: Facts, values: dict[str, float]) -> tuple[Trial, ...]:
    """Explore until no family is left; V by family."""
    trials: tuple[Trial, ...] = ()
    agent = ExpertAgent()
    while True:
        proposal = agent.propose(view(known, trials, "explore"))
        if proposal is None or proposal.family in {t.family for t in trials}:
            return trials
        trials = (*trials, trial(proposal, len(trials) + 1, values.get(proposal.family, 0.9)))


def next_title(known: Facts, trials: tuple[Trial, ...]) -> str:
    proposal = ExpertAgent().propose(view(known, trials, "refine"))
    assert proposal is not None
    return proposal.title


def test_the_ladder_tries_each_family_once_and_physics_first() -> None:
    with_physics = [t.family for t in climb(facts(physics=True), {})]
    assert with_physics[0] == "greybox"
    assert len(with_physics) == len(set(with_physics)) == 6
    without = [t.family for t in climb(facts(physics=False), {})]
    assert without[0] == "linear"
    assert not {"greybox", "hybrid"} & set(without)


def test_a_grey_box_that_fails_on_top_gets_an_overflow_then_a_limit_alone() -> None:
    known = facts(physics=True)
    trials = climb(known, {"greybox": 0.3})
    first = replace(trials[0], diagnostics=(replace(CLEAN, top_error=2.0),))
    trials = (first, *trials[1:])
    assert next_title(known, trials) == "grey-box: x1 runs over"
    proposal = ExpertAgent().propose(view(known, trials, "refine"))
    assert proposal is not None
    assert proposal.parent == first.number
    assert 'saturation=("x1",), spill=True' in proposal.source
    worse = trial(proposal, len(trials) + 1, 0.35)
    assert next_title(known, (*trials, worse)) == "grey-box: x1 saturates"


def test_a_biased_grey_box_gets_an_offset_before_other_things() -> None:
    known = facts(physics=True)
    trials = climb(known, {"greybox": 0.3})
    first = replace(trials[0], diagnostics=(replace(CLEAN, bias=0.2),))
    assert next_title(known, (first, *trials[1:])) == "grey-box: output offset"


def test_overfit_and_plateau_are_read_from_the_training_side() -> None:
    known = facts(physics=False)
    one = climb(known, {"linear": 0.4})[0]
    assert overfit(one) == 4.0
    y = np.minimum(np.sin(np.arange(400) / 20), 0.5)
    flat = replace(known, records=(Trajectory(y, y, 1.0),))
    assert plateau_share(flat) > 0.2
    assert plateau_share(known) < 0.02
