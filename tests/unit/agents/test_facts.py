"""Facts of a problem for agents."""

from dataclasses import replace

import numpy as np

from asia.agents.library.registry import family
from asia.agents.library.traits import traits
from asia.agents.view import Effort
from asia.data.trajectory import Trajectory
from asia.problem import Physics
from asia.problem.load import load_problem
from asia.problem.protocol import FoldRule, Group, ProtocolRule
from asia.search.agent_views import problem_facts
from tests.unit.agents.searches import simulation, windows


def test_facts_carry_protocol_groups_and_budget() -> None:
    problem = load_problem("two_tanks_sim")
    facts = problem_facts(problem)
    assert (facts.n_past_u, facts.n_past_y, facts.past) == (5, 5, 5)
    assert (facts.horizon, facts.metric, facts.early_stopping) == (None, "rmse", "inner")
    assert (facts.groups, facts.folds, facts.fit_samples) == ((), 2, facts.samples // 2)
    assert facts.budget == Effort(problem.budget.experiments, problem.budget.fit_seconds)
    groups = (Group("one", ("a", "b")), Group("two", ("c",)), Group("three", ("d",)))
    rule = ProtocolRule(
        "windows",
        FoldRule("leave_one_group_out", 3, groups),
        past_inputs=0,
        past_outputs=1,
        metric="mae",
        early_stopping="validation",
        horizon=50,
    )
    flown = problem_facts(replace(problem, protocol=rule))
    assert flown.groups == (("a", "b"), ("c",), ("d",))
    assert (flown.horizon, flown.metric, flown.early_stopping) == (50, "mae", "validation")
    assert (flown.n_past_u, flown.n_past_y, flown.folds) == (0, 1, 3)


def test_traits_name_the_kind_of_problem() -> None:
    assert traits(simulation(physics=True)) == {"physics", "parameters", "single", "short"}
    assert traits(windows()) == {"windows", "measured", "single", "long"}
    body = Physics(states=("x", "v"), dynamics={"x": "v", "v": "-x + u"}, observation={"y": "x"})
    one = replace(simulation(physics=False), physics=body)
    assert traits(one) == {"physics", "single", "short"}
    both = replace(one, outputs=(one.outputs[0], replace(one.outputs[0], name="v")))
    assert traits(both) == {"physics", "measured", "several", "short"}


def test_a_lightly_damped_mode_is_a_trait() -> None:
    known, rng = simulation(physics=False), np.random.default_rng(1)
    for damping, expected in ((0.02, True), (0.4, False)):
        pole = np.exp(0.6 * complex(-damping, (1 - damping**2) ** 0.5))
        u, y = rng.normal(size=600), np.zeros(600)
        for k in range(2, 600):
            y[k] = 2 * pole.real * y[k - 1] - abs(pole) ** 2 * y[k - 2] + u[k - 1]
        y += 0.01 * y.std() * rng.normal(size=600)
        record = Trajectory(u[:, None], y[:, None], 1.0, "r")
        facts = replace(known, records=(record,))
        assert ("resonant" in traits(facts)) == expected
        row = family("neural_ss")
        assert row is not None
        assert (row.trial(facts).get("nonlinearity") == "modal") == expected
