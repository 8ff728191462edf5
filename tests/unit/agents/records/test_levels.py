"""Levels of excitation and periods, and what the expert makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from asia.agents import Facts
from asia.agents.expert.agent import ExpertAgent
from asia.agents.library.registry import family
from asia.agents.library.traits import periodic
from asia.data import Trajectory
from asia.data.statistics import several_levels
from tests.unit.agents.searches import simulation, trial, view


def excited(levels: tuple[float, ...], periods: int) -> Facts:
    """Two records a level, of that many periods of noise."""
    rng = np.random.default_rng(0)
    records: list[Trajectory] = []
    for level in (*levels, *levels):
        noise = rng.standard_normal(100)
        u = np.tile(level * noise / noise.std(), periods)
        records.append(Trajectory(u, 2.0 * u, 1.0, str(len(records))))
    return replace(simulation(physics=False), records=tuple(records))


def moves_after_linear(facts: Facts) -> str:
    row = family("linear")
    assert row is not None
    first = ExpertAgent().propose(view(facts, (), "explore"))
    assert first is not None
    made = replace(first, source=row.trial(facts).source(""), family="linear")
    proposal = ExpertAgent().propose(view(facts, (trial(made, 1, 0.1),), "explore"))
    assert proposal is not None
    return proposal.title


@pytest.mark.parametrize(("levels", "several"), [((1.0,), False), ((1.0, 2.0, 3.0), True)])
def test_levels_are_seen(levels: tuple[float, ...], several: bool) -> None:
    assert several_levels(excited(levels, 2).records) is several


def test_one_loud_record_is_no_level() -> None:
    facts = excited((1.0,), 1)
    loud = replace(facts.records[0], u=5.0 * facts.records[0].u)
    assert not several_levels((*facts.records, loud))


def test_periods_are_seen_where_whole_records_are_simulated() -> None:
    assert periodic(excited((1.0,), 3))
    assert not periodic(excited((1.0,), 1))
    assert not periodic(replace(excited((1.0,), 3), horizon=10))


def test_periodic_records_of_several_levels_get_a_system_each_at_once() -> None:
    assert "systems by level" in moves_after_linear(excited((1.0, 2.0), 3))
    assert "systems by level" not in moves_after_linear(excited((1.0,), 3))
