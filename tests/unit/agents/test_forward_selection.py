"""Forward selection of effects, on made-up evidence."""

from dataclasses import replace

import pytest

from asia.agents import Facts, Trial
from asia.agents.expert.agent import ExpertAgent, carried, effects
from asia.agents.library.move import plain_title
from asia.agents.view import LINEAR
from tests.unit.agents.searches import (
    CLEAN,
    following,
    recipe_of,
    search,
    simulation,
    trial,
    view,
    windows,
)


def begun(known: Facts, **values: float) -> tuple[Trial, ...]:
    """First trials of so many families, the given V by family and 0.9 for the others."""
    trials: tuple[Trial, ...] = ()
    while not set(values) <= {t.family for t in trials}:
        proposal = following(known, trials, "explore")
        trials = (*trials, trial(proposal, len(trials) + 1, values.get(proposal.family, 0.9)))
    return trials


def test_what_the_user_gave_comes_first_and_a_shown_effect_interrupts_the_ladder() -> None:
    known = replace(simulation(physics=True), description="Two tanks in series.")
    first = following(known, (), "explore")
    assert first.family == "greybox"
    plain = trial(first, 1, 0.3)
    assert following(known, (plain,), "explore").parent is None
    shown = replace(plain, diagnostics=(replace(CLEAN, top_error=2.0),))
    assert following(known, (shown,), "explore").title == "grey-box: x1 runs over"


def test_the_effect_with_the_largest_share_comes_first_and_is_struck_out_without_a_gain() -> None:
    known = simulation(physics=False)
    trials = begun(known, linear=0.3)
    trials = tuple(
        replace(t, diagnoses=(("time", 0.5), ("inputs", 0.2))) if t.family == "linear" else t
        for t in trials
    )
    made: list[str] = []
    for _ in range(2):
        proposal = following(known, trials)
        made.append(plain_title(proposal.title))
        trials = (*trials, trial(proposal, len(trials) + 1, 0.35))
    assert made[0] == "linear state-space: slow disturbance in the noise"
    assert len(set(made)) == 2


def test_after_two_effects_without_a_gain_the_next_family_gets_its_trial() -> None:
    known = simulation(physics=False)
    left = replace(CLEAN, whiteness=0.9)
    trials = begun(known, nl_lfr=0.3)
    trials = tuple(
        replace(t, diagnostics=(left, left)) if t.family == "nl_lfr" else t for t in trials
    )
    parents: list[int | None] = []
    for _ in range(4):
        proposal = following(known, trials)
        parents.append(proposal.parent)
        trials = (*trials, trial(proposal, len(trials) + 1, 0.35, left))
    assert None in parents[:3]


@pytest.mark.parametrize(("folds", "both"), [((0.29, 0.36), True), ((0.35, 0.36), False)])
def test_a_family_within_one_standard_error_is_carried_on(
    folds: tuple[float, float], both: bool
) -> None:
    known = simulation(physics=False)
    trials = begun(known, nl_lfr=0.3, linear=0.32)
    trials = tuple(replace(t, folds=folds) if t.family == "linear" else t for t in trials)
    seen = {at.row.name for at in carried(view(known, trials, "refine"))}
    assert seen == ({"nl_lfr", "linear"} if both else {"nl_lfr"})
    shown = [one for one in effects(view(known, trials, "refine")) if one.share > 0.0]
    assert {one.family for one in shown} <= seen


def test_a_family_whose_trial_ended_in_the_linear_model_is_not_refined() -> None:
    known = simulation(physics=False)
    trials = begun(known, nl_lfr=0.3, linear=0.3)
    trials = tuple(replace(t, variant=LINEAR) if t.family == "nl_lfr" else t for t in trials)
    assert {at.row.name for at in carried(view(known, trials, "refine"))} == {"linear"}


@pytest.mark.parametrize("known", [simulation(physics=True), simulation(physics=False), windows()])
def test_proposals_are_new_configurations(known: Facts) -> None:
    trials = search(ExpertAgent, known, 25)
    assert len(trials) == 25
    assert len({recipe_of(t).key for t in trials}) == 25
