"""Honest candidates under the checks that cheats are flagged by: every model family of the library,
on the two-tank simulation and on windows of a small made-up drone."""

import time
from dataclasses import dataclass, replace

import numpy as np

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.agents.view import Facts
from asia.candidate import Context, check_source, executed_source
from asia.data.trajectory import Signal, Trajectory
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.relations import suspicions
from asia.judge.evaluation.requests import simulate_held_out
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Isolation, Limits
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.physics import ParameterRange, Physics
from asia.problem.problem import Problem
from asia.problem.protocol import ProtocolRule
from asia.search.agent_views import problem_facts
from tests.redteam.arena import Interruption
from tests.redteam.types import HonestFinding

TWO_TANKS, SMALL_DRONE = "two_tanks_sim", "small drone"


@dataclass(frozen=True)
class HonestProblem:
    """Problem for honest candidates."""

    name: str
    """Name or path of the problem."""
    facts: Facts
    rule: ProtocolRule
    seconds: float = 120.0
    """Time limit of a fit in seconds."""
    tiny: bool = True
    """Whether the smallest models of each family are used."""

    @property
    def context(self) -> Context:
        """The context that candidates receive."""
        return Context(**self.facts.known(), seed=1)

    @property
    def families(self) -> tuple[Family, ...]:
        """Those that can be used on it."""
        return tuple(row for row in all_families() if row.suits(self.facts))

    def source(self, row: Family) -> str:
        """The family's first candidate."""
        recipe = row.smallest(self.facts) if self.tiny else row.trial(self.facts)
        return recipe.source(row.label)


def small_problems() -> tuple[HonestProblem, ...]:
    """Both, small enough for every family."""
    tanks = problem_named(TWO_TANKS)
    records = tuple(record[:160] for record in tanks.facts.records)
    return replace(tanks, facts=replace(tanks.facts, records=records), tiny=True), small_drone()


def problem_named(name: str) -> HonestProblem:
    """A problem by name or path, in full. Raises UserError as `load_problem`."""
    problem: Problem = load_problem(name)
    seconds = problem.budget.fit_seconds
    return HonestProblem(name, problem_facts(problem), problem.protocol, seconds, tiny=False)


def small_drone() -> HonestProblem:
    """Height and climb rate of a body under one rotor, in windows from one measured sample."""
    rng = np.random.default_rng(2)
    records: list[Trajectory] = []
    for name in ("first", "second"):
        speed = 1.0 + 0.1 * np.repeat(rng.normal(size=9), 12)
        state = np.zeros((len(speed), 2))
        for k in range(len(speed) - 1):
            rate = np.array([state[k, 1], 9.81 * speed[k] ** 2 - 9.81 - 0.3 * state[k, 1]])
            state[k + 1] = state[k] + 0.02 * rate
        noise = rng.normal(size=state.shape) * (1e-3, 5e-3)
        records.append(Trajectory(speed, state + noise, 0.02, name))
    facts = Facts(
        description="",
        inputs=(Signal("speed"),),
        outputs=(Signal("z", "m"), Signal("vz", "m/s")),
        sampling_time=0.02,
        records=tuple(records),
        n_past_u=0,
        n_past_y=1,
        physics=Physics(
            states=("z", "vz"),
            dynamics={"z": "vz", "vz": "thrust*speed**2 - 9.81 - drag*vz"},
            parameters={"thrust": ParameterRange(5.0, 20.0), "drag": ParameterRange(0.05, 2.0)},
        ),
        horizon=15,
        metric="mae",
    )
    rule = ProtocolRule("windows", past_inputs=0, past_outputs=1, metric="mae", horizon=15)
    return HonestProblem(SMALL_DRONE, facts, rule)


def try_honest(
    problem: HonestProblem, row: Family, level: Isolation, interruption: Interruption
) -> HonestFinding:
    """Fit the family on the first fold and put its model through lint and metamorphic checks, in
    a worker that has answered nothing."""
    begin = time.monotonic()
    source = problem.source(row)
    fold = make_folds(problem.facts.records, problem.rule)[0]
    limits, horizon = Limits(problem.seconds, problem.seconds, 4096), problem.rule.horizon
    try:
        check_source(source)
        with open_worker(level, limits) as worker, interruption.ends(worker):
            worker.fit(executed_source(source), fold.train, problem.context)
            y_hat = simulate_held_out(worker, fold.held_out)
            model = worker.dump()
        with open_worker(level, limits) as worker, interruption.ends(worker):
            worker.load(executed_source(source), model, problem.context)
            followed = [i for i, known in enumerate(fold.followed) if known]
            found = suspicions(worker, fold.held_out, y_hat, fold.scale, horizon, followed=followed)
    except CandidateError as error:
        flagged = error.reason in (Reason.SOURCE_SIZE, Reason.SUSPECT, Reason.RESTART)
        failure = None if flagged else error.reason
        seconds = time.monotonic() - begin
        return HonestFinding(row.name, problem.name, flagged, str(error)[:200], seconds, failure)
    words = ", ".join(one.kind for one in found)
    return HonestFinding(row.name, problem.name, bool(found), words, time.monotonic() - begin)
