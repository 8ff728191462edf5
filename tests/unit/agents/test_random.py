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


def test_the_papers_space_has_its_own_name_and_the_papers_families() -> None:
    agent = make_agent("random", "paper")
    assert agent.name == "random-paper"
    trials = search(lambda: make_agent("random", "paper"), windows(), 30)
    assert len(trials) == 30
    assert {t.family for t in trials} <= {"autoregressive", "physics_net"}
    assert make_agent("random", "library").name == make_agent("random").name == "random"


def test_a_space_is_refused_where_nothing_is_drawn_and_when_it_is_unknown() -> None:
    with pytest.raises(UserError, match="only the agent 'random'"):
        make_agent("expert", "paper")
    with pytest.raises(UserError, match="expected one of library, paper"):
        make_agent("random", "everything")
    with pytest.raises(UserError, match="no agent 'nobody'"):
        make_agent("nobody")
