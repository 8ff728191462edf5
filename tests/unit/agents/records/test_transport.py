"""Delays that an input sets, in records, and the absence of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.agents import Facts, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.data import Signal, Trajectory
from asia.data.level_responses import pacing_input
from tests.unit.agents.searches import recipe_of, simulation, trial, view
from tests.unit.models.systems.transport import belt


def facts_of(record: Trajectory) -> Facts:
    known = simulation(physics=False)
    return replace(known, inputs=(Signal("speed"), Signal("load")), records=(record,))


def mixed(samples: int, seed: int) -> Trajectory:
    """A first-order lag of the product of two positive inputs, with a constant delay of 5."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 1.5, (samples // 10 + 1, 2)), 10, axis=0)[:samples]
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + 0.3 * np.prod(u[max(k - 5, 0)])
    return Trajectory(u, y + 0.01 * rng.normal(size=samples), 1.0)


def test_a_belt_is_seen_in_the_record() -> None:
    assert pacing_input(facts_of(belt(500, 0)).records) == 0


@pytest.mark.slow
def test_a_constant_delay_is_not_taken_for_a_belt() -> None:
    assert pacing_input(facts_of(mixed(500, 0)).records) is None


@pytest.mark.slow
def test_the_expert_lets_the_input_set_the_delay() -> None:
    for record, expected in ((belt(500, 0), 0), (mixed(500, 0), None)):
        trials: tuple[Trial, ...] = ()
        for number in range(1, 9):
            proposal = ExpertAgent().propose(view(facts_of(record), trials, "explore"))
            assert proposal is not None
            trials = (*trials, trial(proposal, number, 0.5))
        paces = {recipe_of(t).get("transport") for t in trials}
        assert paces - {None} == ({expected} - {None})
