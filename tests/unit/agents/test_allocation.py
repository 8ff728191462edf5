"""The rule by which the expert divides its experiments among families, on made-up outcomes."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from asia.agents import ExpertAgent, Facts, Proposal, Trial
from asia.agents.expert import agent
from asia.agents.expert.allocation import Allocation
from asia.agents.library.registry import families, family

from .searches import by_luck, recipe_of, search, simulation, trial, view, windows

Outcome = Callable[[Proposal, int], Trial]
KINDS = {"plain": simulation(physics=False), "physics": simulation(physics=True), "w": windows()}


def baseline(known: Facts) -> Trial:
    row = family("linear")
    assert row is not None
    source = row.trial(known).source("")
    return trial(Proposal(source, "baseline", "baseline", "", ""), 1, 0.9)


def better_each_time(name: str) -> Outcome:
    """Only this family improves, and leads from its first experiment on by far."""

    def outcome(proposal: Proposal, number: int) -> Trial:
        return trial(proposal, number, (0.3 if proposal.family == name else 0.9) / number**0.1)

    return outcome


def close_race(proposal: Proposal, number: int) -> Trial:
    """The first family is ahead of all others by 10 %."""
    ahead = proposal.family in ("nl_lfr", "greybox", "autoregressive")
    return trial(proposal, number, (0.45 if ahead else 0.5) - 0.0001 * number)


def unlucky_linear(proposal: Proposal, number: int) -> Trial:
    """All fits of two families end in an error."""
    crashed = replace(trial(proposal, number, None), status="crash")
    failing = proposal.family in ("linear", "neural_ss")
    return crashed if failing else better_each_time("nl_lfr")(proposal, number)


OUTCOMES: dict[str, Outcome] = {
    "luck": by_luck,
    "nl_lfr leads": better_each_time("nl_lfr"),
    "greybox leads": better_each_time("greybox"),
    "close": close_race,
    "failures": unlucky_linear,
}


def leads(name: str, trials: tuple[Trial, ...]) -> bool:
    own = [t.value for t in trials if recipe_of(t).family == name and t.value is not None]
    others = [t.value for t in trials if recipe_of(t).family != name and t.value is not None]
    return bool(own and others) and min(own) <= 0.8 * min(others)


def has_equations(name: str) -> bool:
    row = family(name)
    return row is not None and row.kind == "equations"


@pytest.mark.parametrize("experiments", [3, 4, 8, 15])
@pytest.mark.parametrize("outcome", OUTCOMES.values(), ids=OUTCOMES)
@pytest.mark.parametrize("known", KINDS.values(), ids=KINDS)
def test_no_family_takes_the_budget(known: Facts, outcome: Outcome, experiments: int) -> None:
    trials = search(ExpertAgent, known, experiments, outcome, begun=(baseline(known),))
    assert len(trials) == experiments
    names = [recipe_of(t).family for t in trials]
    half = max(1, (experiments - 1) // 2)
    for place in range(1, experiments):
        name, before = names[place], names[:place]
        if before.count(name) >= 2:
            served = {other for other in before if before.count(other) >= 2}
            early = has_equations(name) and len(set(before)) >= 3 and leads(name, trials[:place])
            assert len(served) >= 3 or early, f"experiment {place + 1}: {names}"
        if names[1:place].count(name) >= half:
            assert leads(name, trials[:place]), f"experiment {place + 1}: {names}"


def test_the_hypothesis_says_where_the_rule_decided() -> None:
    known = simulation(physics=False)
    outcome = better_each_time("nl_lfr")
    trials = search(ExpertAgent, known, 8, outcome, begun=(baseline(known),))
    waiting = [t for t in trials if "nonlinear LFR waits" in t.hypothesis]
    assert waiting
    assert all(recipe_of(t).family != "nl_lfr" for t in waiting)
    assert "nonlinear LFR waits" not in trials[1].hypothesis
    close = search(ExpertAgent, known, 12, close_race, begun=(baseline(known),))
    had = [t for t in close if "has had" in t.hypothesis]
    assert had
    assert "No family gets more than half of the 11 experiments" in had[0].hypothesis


def test_a_grey_box_that_leads_goes_on_once_two_others_were_tried() -> None:
    known = simulation(physics=True)
    outcome = better_each_time("greybox")
    names = [recipe_of(t).family for t in search(ExpertAgent, known, 15, outcome)]
    third = [place for place, name in enumerate(names) if name == "greybox"][2]
    assert len(set(names[:third])) >= 3
    assert names.count("greybox") > 7


def test_the_linear_reference_counts_as_a_trial_next_to_a_grey_box() -> None:
    known = simulation(physics=True)
    outcome = better_each_time("greybox")
    trials = tuple(t for t in search(ExpertAgent, known, 15, outcome) if t.family == "greybox")[:2]
    other = next(t for t in search(ExpertAgent, known, 15, outcome) if t.family == "nl_lfr")
    seen = view(known, (*trials, other), "refine")
    assert Allocation.of(seen).objection("greybox")
    assert not Allocation.of(replace(seen, linear=0.9)).objection("greybox")
    close = replace(seen, linear=trials[0].value)
    assert Allocation.of(close).objection("greybox")


def test_the_rule_is_relaxed_when_only_two_families_apply(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [row for row in families(simulation(physics=False)) if row.name in ("nl_lfr", "esn")]
    monkeypatch.setattr(agent, "families", lambda facts: rows)
    trials = search(ExpertAgent, simulation(physics=False), 10, better_each_time("nl_lfr"))
    names = [t.family for t in trials]
    assert len(names) == 10
    assert set(names) == {"nl_lfr", "esn"}
    assert names.count("nl_lfr") > 2
