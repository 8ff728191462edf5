"""Dry friction, hysteresis and play in records, and the absence of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest

from asia.agents import Trial
from asia.agents.expert.agent import ExpertAgent
from asia.data import Trajectory
from asia.data.statistics import Cause, switching
from tests.unit.agents.searches import recipe_of, simulation, trial, view
from tests.unit.models.systems.equations import duffing_record
from tests.unit.models.systems.friction import (
    backlash,
    bristle,
    record,
    sliding,
    sticking,
    yielding,
)

CASES: dict[str, tuple[Cause, Callable[[], Trajectory]]] = {
    "stick-slip": ("displacement", cache(lambda: record(sliding, 2, 100))),
    "velocity": ("velocity", cache(lambda: record(sticking, 1, 100))),
    "presliding": ("displacement", cache(lambda: record(bristle, 3, 100))),
    "Bouc-Wen": ("displacement", cache(lambda: record(yielding, 3, 100))),
    "play": ("input", cache(lambda: backlash(100))),
}


def of_records(*records: Trajectory):
    return switching(records)


@pytest.mark.parametrize("case", CASES)
def test_switching_is_detected_in_the_record(case: str) -> None:
    cause, found = CASES[case][0], of_records(CASES[case][1]())
    assert found.found
    assert (found.cause, found.signal) == (cause, 0)


def test_a_smooth_spring_is_not_taken_for_friction() -> None:
    assert not of_records(duffing_record(400, 100, 0.003), duffing_record(400, 101, 0.003)).found


@pytest.mark.slow
def test_records_too_short_to_tell_say_nothing() -> None:
    assert not of_records(record(sliding, 2, 100)[:100]).found


@pytest.mark.parametrize(
    ("case", "setting"),
    [("velocity", "friction"), ("Bouc-Wen", "friction"), ("play", "play")],
)
def test_the_expert_gives_a_black_box_the_element_that_the_record_asks_for(
    case: str, setting: str
) -> None:
    known = replace(simulation(physics=False), records=(CASES[case][1](),))
    trials: tuple[Trial, ...] = ()
    for number in range(1, 16):
        proposal = ExpertAgent().propose(view(known, trials, "explore"))
        assert proposal is not None
        recipe = recipe_of(proposal)
        if recipe.get(setting):
            break
        trials = (*trials, trial(proposal, number, 0.5))
    assert proposal.family == "neural_ss"
    assert recipe.get(setting) == 1
    assert recipe.get("nonlinearity") == "none"


def test_the_expert_leaves_a_smooth_system_without_elements() -> None:
    known = replace(simulation(physics=False), records=(duffing_record(400, 100, 0.003),))
    trials: tuple[Trial, ...] = ()
    for number in range(1, 16):
        proposal = ExpertAgent().propose(view(known, trials, "refine"))
        assert proposal is not None
        assert not recipe_of(proposal).get("friction")
        assert not recipe_of(proposal).get("play")
        trials = (*trials, trial(proposal, number, 0.5))
