"""Numbers tuned by Optuna inside a bounded number of experiments."""

import pytest

from asia.agents import Proposal, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.moves import TUNED
from asia.agents.library.move import plain_title
from tests.unit.agents.searches import CLEAN, recipe_of, search, simulation, trial, view

KNOWN = simulation(physics=True)
BEST = 3e-3


def bowl(proposal: Proposal, number: int) -> Trial:
    """V of the grey-box has its least value at one ridge; nothing else matters."""
    if proposal.family != "greybox":
        return trial(proposal, number, 2.0)
    ridge = recipe_of(proposal).number("ridge", 1e-3)
    return trial(proposal, number, 0.12 + 0.1 * abs(ridge - BEST) / BEST)


@pytest.fixture(scope="module")
def trials() -> tuple[Trial, ...]:
    return search(ExpertAgent, KNOWN, 50, bowl)


def tuned(trials: tuple[Trial, ...]) -> list[Trial]:
    return [t for t in trials if plain_title(t.title).endswith(f": {TUNED}")]


@pytest.mark.slow
def test_tuning_takes_at_most_a_fifth_of_the_budget(trials: tuple[Trial, ...]) -> None:
    assert 3 <= len(tuned(trials)) <= 10


def test_tuning_changes_only_numbers_of_the_leading_family(trials: tuple[Trial, ...]) -> None:
    by_number = {t.number: t for t in trials}
    for done in tuned(trials):
        assert done.family == "greybox"
        assert done.parent is not None
        before = dict(recipe_of(by_number[done.parent]).config)
        after = dict(recipe_of(done).config)
        changed = {name for name in after if after[name] != before[name]}
        assert changed
        assert changed <= {"ridge", "residual_ridge"}
        assert 1e-5 <= recipe_of(done).number("ridge", 0) <= 1e-1


def test_tuning_finds_a_better_number_than_the_moves(trials: tuple[Trial, ...]) -> None:
    best = min(trials, key=lambda t: t.value or 9.0)
    assert plain_title(best.title).endswith(f": {TUNED}")
    assert best.value is not None
    assert best.value < 0.16


def test_the_same_view_gives_the_same_numbers_and_another_seed_others(
    trials: tuple[Trial, ...],
) -> None:
    where = trials.index(tuned(trials)[-1])
    now = [view(KNOWN, trials[:where], "refine", 50 - where, seed) for seed in (0, 0, 1)]
    first, again, other = (ExpertAgent().propose(v) for v in now)
    assert first is not None
    assert other is not None
    assert first == again
    assert plain_title(first.title) == plain_title(other.title)
    assert first.source != other.source


def test_made_up_evidence_is_near_white() -> None:
    """The bowl leaves tuning as the only move with a promise."""
    assert CLEAN.whiteness < 0.5
