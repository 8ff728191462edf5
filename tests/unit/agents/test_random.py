"""The controls."""

import pytest

from asia.agents import make_agent
from asia.agents.library.registry import families
from asia.agents.random import RandomAgent
from asia.errors import UserError
from tests.unit.agents.searches import recipe_of, search, simulation, view, windows


@pytest.mark.long
def test_random_draws_every_family_and_never_twice() -> None:
    known = simulation(physics=True)
    trials = search(RandomAgent, known, 150)
    assert {t.family for t in trials} == {row.name for row in families(known)}
    assert len({recipe_of(t).key for t in trials}) == 150


def test_draws_depend_on_the_seed_and_the_place_in_the_search() -> None:
    known = windows()
    now = [view(known, (), "explore", seed=seed) for seed in (0, 0, 1)]
    first, again, other = (RandomAgent().propose(v) for v in now)
    assert first == again
    assert first != other


def test_an_unknown_agent_is_refused() -> None:
    with pytest.raises(UserError, match="no agent 'nobody'"):
        make_agent("nobody")
