"""Notes of `asia steer` that the expert follows."""

from dataclasses import replace

import pytest

from asia.agents import AgentView, Facts, Proposal, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.notes import READS, read_notes

from .searches import CLEAN, recipe_of, simulation, trial, view

PLAIN, PHYSICS = simulation(physics=False), simulation(physics=True)


def asked(known: Facts, trials: tuple[Trial, ...], *notes: str) -> Proposal:
    seen: AgentView = replace(view(known, trials, "explore"), notes=notes)
    proposal = ExpertAgent().propose(seen)
    assert proposal is not None
    return proposal


def continued(
    known: Facts, *notes: str, count: int = 4, begun: tuple[Trial, ...] = ()
) -> list[Proposal]:
    trials, found = begun, list[Proposal]()
    for _ in range(count):
        found.append(asked(known, trials, *notes))
        trials = (*trials, trial(found[-1], len(trials) + 1, 0.5 - 0.01 * len(trials), CLEAN))
    return found


@pytest.mark.parametrize(
    ("note", "wishes"),
    [
        ("try narx", ["try polynomial NARX"]),
        ("Please use a neural state-space model", ["try neural state-space"]),
        ("avoid nl_lfr", ["no nonlinear LFR"]),
        ("do not try nl_lfr, try gp-narx", ["no nonlinear LFR", "try Gaussian-process NARX"]),
        ("avoid nl_lfr and esn", ["no nonlinear LFR", "no echo state network"]),
        ("ltc please", ["try LTC network"]),
        ("the pump saturates at 8 V", ["try saturation"]),
        ("there is no saturation", ["no saturation"]),
        ("I think there is dry friction in the joint.", ["try friction"]),
        ("a delay of 12 samples", ["try a delay of 12 samples"]),
        ("there is a 7 samples delay", ["try a delay of 7 samples"]),
        ("the system is not linear", []),
        ("nl_lfr is slow", []),
        ("the operator was on holiday", []),
        ("a delay of 3 s", []),
    ],
)
def test_plain_notes_are_understood_and_others_are_not(note: str, wishes: list[str]) -> None:
    found, answers = read_notes([note])
    assert [wish.text for wish in found] == wishes
    assert answers == (() if wishes else (f"note 1 is not understood: {READS}",))


def test_a_family_to_try_is_the_next_experiment_and_only_once() -> None:
    found = continued(PLAIN, "try gp_narx")
    assert found[0].family == "gp_narx"
    assert found[0].hypothesis.endswith("Note 1 is followed: try Gaussian-process NARX.")
    assert all("Note 1" not in proposal.hypothesis for proposal in found[1:])
    plain = continued(PLAIN, count=1)[0]
    assert plain.family != "gp_narx"
    assert plain.hypothesis.find("Note") == -1


def test_a_family_that_was_tried_is_refined() -> None:
    first = continued(PLAIN, "try linear", count=2)
    trials = (trial(first[0], 1, 0.9), trial(first[1], 2, 0.2))
    again = asked(PLAIN, trials, "try linear", "use a linear state-space model")
    assert again.family == "linear"
    assert again.parent == 1
    assert "Note 2 is followed" in again.hypothesis


def test_a_family_to_avoid_is_not_proposed_and_the_next_experiment_says_so() -> None:
    assert "nl_lfr" in {proposal.family for proposal in continued(PLAIN, count=8)}
    found = continued(PLAIN, "avoid nl_lfr", count=8)
    assert "nl_lfr" not in {proposal.family for proposal in found}
    assert "Note 1 is followed: no nonlinear LFR." in found[0].hypothesis
    assert "Note 1" not in found[1].hypothesis
    # A later note overrides.
    assert continued(PLAIN, "avoid nl_lfr", "try nl_lfr", count=1)[0].family == "nl_lfr"


@pytest.mark.parametrize(
    ("known", "note", "setting"),
    [
        (PHYSICS, "the pump saturates", ("saturation", ("x1",))),
        (PHYSICS, "delay of 6 samples", ("input_delay", 7.0)),
        (PLAIN, "delay of 6 samples", ("delay", 5)),
        (PLAIN, "dry friction", ("friction", 1)),
    ],
)
def test_an_effect_is_added_to_the_best_trial(
    known: Facts, note: str, setting: tuple[str, object]
) -> None:
    first = continued(known, count=1)[0]
    followed = asked(known, (trial(first, 1, 0.5),), note)
    assert recipe_of(followed).get(setting[0]) == setting[1]
    assert "Note 1 is followed" in followed.hypothesis
    assert recipe_of(asked(known, (trial(first, 1, 0.5),))).get(setting[0]) != setting[1]


def test_saturation_without_equations_tries_a_static_function() -> None:
    followed = continued(PLAIN, "there is saturation", count=1)[0]
    assert followed.family == "block_oriented"


def test_a_note_that_is_not_understood_or_cannot_be_followed_is_answered_in_a_line() -> None:
    proposal = asked(PLAIN, (), "good luck", "try hybrid")
    assert proposal.remark == (
        f"note 1 is not understood: {READS}; note 2: nothing new to try for 'try hybrid' on "
        f"this problem"
    )
    assert "Note" not in proposal.hypothesis
    assert asked(PLAIN, (), "try narx").remark == ""
