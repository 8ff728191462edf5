"""Families and agents that other packages bring, and agents in loose files."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import asia._plugins as plugins
from asia._plugins import Part
from asia.agents import Facts
from asia.agents.bayes import BayesAgent
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.moves import all_moves
from asia.agents.library.pages import families_page
from asia.agents.library.registry import all_cards, all_families, families
from asia.agents.llm.prompt import library
from asia.agents.random import RandomAgent
from asia.agents.registry import AGENTS, choose_agent, recorded_agent
from asia.candidate import check_source
from asia.errors import UserError
from asia.testing import check_agent
from asia.testing.family import check_recipe
from tests.unit.agents.searches import recipe_of, search, simulation

MODEL = """
from dataclasses import dataclass

@dataclass(frozen=True)
class Config:
    gain: float = 1.0

def build(config, context): ...
def train(model, trajectories, context, method): ...
"""
CARD = """
from asia.agents.library.move import Card
from asia.agents.library.family import Family
from asia.agents.library.move import Move
from asia.recipe import Recipe
from asia.agents.library.space import Space, Span

def start(facts):
    return Recipe("static_gain", (("gain", 1.0),), "LeastSquares", (("ridge", None),))

FAMILY = Family(
    name="static_gain", label="static gain", use="no dynamics at all", base=20, start=start,
    space=lambda facts: Space((Span("gain", 0.1, 10.0),), ()), small=(("gain", 2.0),),
    package="plugged_models",
)
CARD = Card((FAMILY,), (
    Move(
        name="twice the gain", evidence=lambda at: 3,
        change=lambda at: at.recipe.times("gain", 2.0, 1.0),
        hypothesis="More.", expected="More.",
    ),
))
CLASH = Family(
    name="arx", label="", use="", base=1, start=start, space=FAMILY.space, small=(),
    package="plugged_models",
)
UNSET = Family(name="own", label="", use="", base=1, start=start, space=FAMILY.space, small=())
NONE = 3
"""
AGENT = """
from asia.agents import Proposal

SOURCE = "def fit(trajectories, context):\\n    return %d\\n"

class Counting:
    name = "counting"

    def propose(self, view):
        number = len(view.trials)
        return Proposal(SOURCE % number, "constant", f"constant {number}", "It counts.", "Little.")

class Impostor(Counting):
    name = "expert"

class Needy(Counting):
    def __init__(self, settings): ...
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a package of models, a module with cards and one with agents."""
    package = tmp_path / "plugged_models"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "static_gain.py").write_text(MODEL)
    (package / "card.py").write_text(CARD)
    (tmp_path / "plugged_card.py").write_text(CARD)
    (tmp_path / "loose_agent.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def plug(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Makes a module's name a part of a kind, as an installed package does."""
    caches = (all_cards, all_families, all_moves)
    monkeypatch.syspath_prepend(folder)

    def brought(group: str, name: str, target: str) -> None:
        part = Part(group, name, target, "plugged", "1.0")
        monkeypatch.setattr(plugins, "_all_parts", lambda: (part,))
        for cached in caches:
            cached.cache_clear()

    yield brought
    monkeypatch.undo()
    for cached in caches:
        cached.cache_clear()


@pytest.mark.long
@pytest.mark.parametrize("name", ["FAMILY", pytest.param("CARD", marks=pytest.mark.slow)])
def test_a_family_of_another_package_is_searched_as_those_here(plug, name: str) -> None:
    known: Facts = simulation(physics=False)
    plug("asia.families", "gain", f"plugged_models.card:{name}")
    assert families(known)[0].name == "static_gain"
    for make in (ExpertAgent, RandomAgent, BayesAgent):
        found = [t for t in search(make, known, 80) if t.family == "static_gain"]
        assert found, make
        for done in found:
            assert "from plugged_models import static_gain\n" in done.source
            check_source(done.source)
            check_recipe(recipe_of(done))
    moved = any(t.title == "static gain: twice the gain" for t in search(ExpertAgent, known, 10))
    assert moved == (name == "CARD")
    assert "static_gain (static gain): no dynamics at all" in library(known)
    assert "from plugged_models import static_gain" in library(known)
    assert "| `static_gain` (package `plugged_models`) | no dynamics" in families_page(known)
    assert "from plugged_models import static_gain" in families_page(known)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("CLASH", "ASIA has a family of this name"),
        ("UNSET", "set `package`"),
        ("NONE", "is no Card, no Family"),
        ("NOTHING", "has no 'NOTHING'"),
    ],
)
def test_a_part_that_is_no_new_family_is_refused(plug, name: str, words: str) -> None:
    plug("asia.families", "gain", f"plugged_card:{name}")
    with pytest.raises(UserError, match=words):
        all_cards()


def test_an_agent_in_a_file_of_the_current_folder(folder: Path) -> None:
    chosen = choose_agent("loose_agent:Counting")
    assert chosen.agent.name == "counting"
    assert chosen.settings == {"class": "loose_agent:Counting"}
    check_agent(lambda: choose_agent("loose_agent:Counting").agent)
    with pytest.raises(UserError, match="--trust-agent with exactly this name"):
        recorded_agent("counting", chosen.settings)
    with pytest.raises(UserError, match="--trust-agent"):
        recorded_agent("counting", chosen.settings, ["loose_agent", "loose_agent:Needy"])
    again = recorded_agent("counting", chosen.settings, ["loose_agent:Counting"])
    assert again is not None
    assert again.name == "counting"


def test_an_agent_of_a_ledger_is_not_imported_without_trust(folder: Path) -> None:
    """Not even to find out what it is: importing it would execute it."""
    (folder / "hostile_agent.py").write_text(f"open({str(folder / 'ran')!r}, 'w')\n")
    with pytest.raises(UserError, match="was not imported"):
        recorded_agent("counting", {"class": "hostile_agent:Counting"})
    assert not (folder / "ran").exists()


def test_an_installed_agent_is_not_looked_for_in_the_current_folder(
    plug, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of the same name lies in the current folder, which is not on the path."""
    elsewhere = folder / "installed"
    elsewhere.mkdir()
    (elsewhere / "other_agent.py").write_text(AGENT)
    (folder / "other_agent.py").write_text("raise SystemError('the wrong one')\n")
    plug("asia.agents", "counter", "other_agent:Counting")
    monkeypatch.setattr("sys.path", [p for p in sys.path if p not in ("", str(folder))])
    monkeypatch.syspath_prepend(elsewhere)
    monkeypatch.setattr("sys.path", [p for p in sys.path if p not in ("", str(folder))])
    assert choose_agent("counter").agent.name == "counting"
    again = recorded_agent("counting", {"class": "other_agent:Counting"})
    assert again is not None


def test_an_agent_by_the_name_its_package_gives_it(plug) -> None:
    plug("asia.agents", "counter", "loose_agent:Counting")
    assert choose_agent("counter").agent.name == "counting"
    with pytest.raises(UserError, match="counter, or module:Class"):
        choose_agent("nobody")
    plug("asia.agents", "expert", "loose_agent:Counting")
    assert isinstance(choose_agent("expert").agent, ExpertAgent)


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("loose_agent:Impostor", "its name is 'expert'"),
        ("loose_agent:Needy", "without arguments failed: TypeError"),
        ("loose_agent:SOURCE", "expected a class"),
        ("loose_agent:Nobody", "has no 'Nobody'"),
        ("no_such_file:Counting", "cannot import no_such_file"),
        ("collections:OrderedDict", "expected a `name`"),
    ],
)
def test_an_invalid_agent_is_refused(folder: Path, target: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        choose_agent(target)


def test_an_external_proposer_is_not_asked_again() -> None:
    assert recorded_agent("workspace", {}) is None
    assert recorded_agent("somebody", {}) is None
    assert {name for name in AGENTS if recorded_agent(name, {}) is not None} == set(AGENTS)
