"""Notes of `asia steer` that the expert follows."""

from dataclasses import replace

import pytest

from asia.agents import AgentView, Facts, Proposal, Trial
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.notes import READS, read_notes

from .searches import CLEAN, simulation, trial, view

PLAIN = simulation(physics=False)


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
        ("try narx", ["try narx"]),
        ("avoid nl_lfr", ["avoid nl_lfr"]),
        (" avoid nl_lfr, cnn", ["avoid nl_lfr", "avoid cnn"]),
        ("try", []),
        ("", []),
        ("try something new", []),
        ("nl_lfr is slow", []),
        ("the pump saturates at 8 V", []),
    ],
)
def test_notes_of_two_forms_are_understood_and_others_are_not(note: str, wishes: list[str]) -> None:
    found, answers = read_notes([note])
    assert [wish.text for wish in found] == wishes
    assert answers == (() if wishes else (f"note 1 is not understood: {READS}",))


def test_a_family_to_try_is_the_next_experiment_and_only_once() -> None:
    found = continued(PLAIN, "try narx")
    assert found[0].family == "narx"
    assert found[0].hypothesis.endswith("Note 1 is followed: try narx.")
    assert all("Note 1" not in proposal.hypothesis for proposal in found[1:])
    plain = continued(PLAIN, count=1)[0]
    assert plain.family != "narx"
    assert plain.hypothesis.find("Note") == -1


def test_a_family_that_was_tried_is_refined() -> None:
    first = continued(PLAIN, "try linear", count=2)
    trials = (trial(first[0], 1, 0.9), trial(first[1], 2, 0.2))
    again = asked(PLAIN, trials, "try linear", "try linear")
    assert again.family == "linear"
    assert again.parent == 1
    assert "Note 2 is followed" in again.hypothesis


def test_a_family_to_avoid_is_not_proposed_and_the_next_experiment_says_so() -> None:
    assert "nl_lfr" in {proposal.family for proposal in continued(PLAIN, count=8)}
    found = continued(PLAIN, "avoid nl_lfr", count=8)
    assert "nl_lfr" not in {proposal.family for proposal in found}
    assert "Note 1 is followed: avoid nl_lfr." in found[0].hypothesis
    assert "Note 1" not in found[1].hypothesis
    # A later note overrides.
    assert continued(PLAIN, "avoid nl_lfr", "try nl_lfr", count=1)[0].family == "nl_lfr"


def test_a_note_that_is_not_understood_or_cannot_be_followed_is_answered_in_a_line() -> None:
    proposal = asked(PLAIN, (), "good luck", "try hybrid")
    assert proposal.remark == (
        f"note 1 is not understood: {READS}; note 2: nothing new to try for 'try hybrid' on "
        f"this problem"
    )
    assert "Note" not in proposal.hypothesis
    assert asked(PLAIN, (), "try narx").remark == ""
