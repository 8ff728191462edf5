"""Made-up searches for the agents' tests."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from asia.agents import Agent, AgentView, Facts, Proposal, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.agents.view import Effort
from asia.candidate import source_digest
from asia.data import Signal, Trajectory
from asia.judge.scoring.residuals import Diagnostics
from asia.problem import ParameterRange, Physics
from asia.recipe import Recipe, read_recipe

CLEAN = Diagnostics(0.1, 0.0, 0.1, 0.05, 1.0, 1.0, 1.0, 0.05)
EQUATIONS = Physics(
    states=("x1", "x2"),
    dynamics={"x1": "-a*x1 + u", "x2": "x1 - a*x2"},
    parameters={"a": ParameterRange(0.01, 1.0)},
    observation={"y": "x2"},
)


def simulation(*, physics: bool, samples: int = 200) -> Facts:
    """One record, simulated as a whole."""
    rng = np.random.default_rng(0)
    record = Trajectory(rng.normal(size=samples), rng.normal(size=samples), 1.0)
    return Facts(
        inputs=(Signal("u"),),
        outputs=(Signal("y"),),
        sampling_time=1.0,
        records=(record,),
        n_past_u=5,
        n_past_y=5,
        physics=EQUATIONS if physics else None,
    )


def windows(*, samples: int = 60_000) -> Facts:
    """Short windows from one measured sample, three groups of records, mean absolute error."""
    return replace(
        simulation(physics=False, samples=samples),
        n_past_u=0,
        n_past_y=1,
        horizon=50,
        metric="mae",
        folds=3,
        groups=(("a",), ("b",), ("c",)),
        budget=Effort(30, 120.0),
    )


def body(*, samples: int = 60_000) -> Facts:
    """Facts as `windows`, with equations whose states are all outputs."""
    rng = np.random.default_rng(1)
    record = Trajectory(rng.normal(size=samples), rng.normal(size=(samples, 2)), 1.0)
    equations = Physics(
        states=("x", "v"),
        dynamics={"x": "v", "v": "-k*x + u"},
        parameters={"k": ParameterRange(0.01, 1.0)},
    )
    return replace(
        windows(samples=samples),
        records=(record,),
        outputs=(Signal("x"), Signal("v")),
        physics=equations,
    )


def recipe_of(proposal: Proposal | Trial) -> Recipe:
    recipe = read_recipe(proposal.source)
    assert recipe is not None
    return recipe


def trial(
    proposal: Proposal, number: int, value: float | None, evidence: Diagnostics = CLEAN
) -> Trial:
    """A trial with this V; None is a diverged simulation."""
    scored = value is not None
    return Trial(
        number, proposal.parent, "explore", proposal.family, proposal.title, proposal.hypothesis,
        proposal.expected, proposal.source, "discard" if scored else "invalid", value,
        (value, value) if value is not None else (), None if scored else "not_finite",
        (evidence, evidence) if scored else (),
    )  # fmt: skip


def view(
    facts: Facts, trials: tuple[Trial, ...], phase: str, remaining: int = 10, seed: int = 0
) -> AgentView:
    tried = {source_digest(t.source) for t in trials}
    return AgentView(
        facts, seed, phase, trials, remaining,  # type: ignore[arg-type]
        lambda source: source_digest(source) in tried,
    )  # fmt: skip


def following(known: Facts, trials: tuple[Trial, ...], phase: str = "refine") -> Proposal:
    """What the expert proposes after these trials."""
    proposal = ExpertAgent().propose(view(known, trials, phase))
    assert proposal is not None
    return proposal


def by_luck(proposal: Proposal, number: int) -> Trial:
    """Evidence and outcome from the source's digest: one in six fails, by time or by diverging."""
    digest = hashlib.sha256(source_digest(proposal.source).encode()).digest()
    if digest[0] % 6 == 0:
        failed = trial(proposal, number, None)
        return failed if digest[1] % 2 else replace(failed, status="timeout")
    value = 0.1 + digest[2] / 256
    train = value * (0.2 + digest[3] / 256)
    evidence = Diagnostics(
        train, digest[4] / 2560, digest[5] / 256, digest[6] / 256, digest[7] / 100, 1.0, 1.0,
        digest[8] / 256,
    )  # fmt: skip
    return trial(proposal, number, value, evidence)


def search(
    make: Callable[[], Agent],
    facts: Facts,
    experiments: int,
    outcome: Callable[[Proposal, int], Trial] = by_luck,
    seed: int = 0,
    begun: tuple[Trial, ...] = (),
) -> tuple[Trial, ...]:
    """A search of so many proposals, two fifths of them exploring; shorter when none is left.
    begun: its first trials."""
    trials = begun
    for number in range(len(begun) + 1, experiments + 1):
        phase = "explore" if number <= 0.4 * experiments else "refine"
        now = view(facts, trials, phase, experiments - number + 1, seed)
        proposal = make().propose(now)
        if proposal is None:
            break
        assert not now.is_known(proposal.source), proposal.title
        trials = (*trials, outcome(proposal, number))
    return trials
