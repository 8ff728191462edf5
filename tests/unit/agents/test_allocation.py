"""The rule by which the expert divides its experiments among families, on made-up outcomes."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from asia.agents import Facts, Proposal, Trial
from asia.agents.expert import agent
from asia.agents.expert.agent import ExpertAgent
from asia.agents.expert.allocation import Allocation
from asia.agents.library.cards.linear import BEST_LINEAR
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


def best_values(trials: tuple[Trial, ...]) -> dict[str, float]:
    found: dict[str, float] = {}
    for t in trials:
        if t.value is not None:
            name = recipe_of(t).family
            found[name] = min(t.value, found.get(name, t.value))
    return found


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
            assert len(set(before)) >= 3, f"experiment {place + 1}: {names}"
        if before.count(name) >= 3:
            best = best_values(trials[:place])
            close = sorted(best, key=lambda n: best[n])[:3]
            close = [n for n in close if best[n] <= 1.5 * min(best.values()) and n != name]
            assert all(before.count(n) >= 2 for n in close), f"experiment {place + 1}: {names}"
        if names[1:place].count(name) >= half:
            assert leads(name, trials[:place]), f"experiment {place + 1}: {names}"


def test_a_family_that_leads_by_far_is_not_held_back() -> None:
    """Families beyond 1.5 times its V get their trials, and no refinements before it."""
    known = simulation(physics=False)
    outcome = better_each_time("nl_lfr")
    trials = search(ExpertAgent, known, 8, outcome, begun=(baseline(known),))
    names = [recipe_of(t).family for t in trials]
    assert names.count("nl_lfr") >= 4
    assert len(set(names)) >= 3


def test_the_hypothesis_says_where_the_rule_decided() -> None:
    known = simulation(physics=False)
    close = search(ExpertAgent, known, 12, close_race, begun=(baseline(known),))
    waiting = [t for t in close if " waits for families within 1.5 times" in t.hypothesis]
    assert waiting
    for one in waiting:
        label = one.hypothesis.partition(" waits")[0].rpartition(". ")[2]
        row = family(recipe_of(one).family)
        assert row is not None
        assert row.label != label


def made(values: dict[str, list[float]]) -> Allocation:
    """Allocation after trials with these V, family by family."""
    known = simulation(physics=False)
    trials: list[Trial] = []
    for name, each in values.items():
        row = family(name)
        assert row is not None
        for number, value in enumerate(each):
            source = row.trial(known).trained(iterations=20 + number).source("")
            proposal = Proposal(source, name, f"{name} {number}", "", "")
            trials.append(trial(proposal, len(trials) + 1, value))
    return Allocation.of(view(known, tuple(trials), "refine", remaining=30))


def test_close_families_are_refined_before_one_gets_its_third_refinement() -> None:
    others = {"linear": [0.14], "narx": [0.2]}
    assert not made({"neural_ss": [0.13, 0.12], **others}).waits("neural_ss")
    third = made({"neural_ss": [0.13, 0.12, 0.1], **others})
    assert third.waits("neural_ss")
    assert not third.waits("linear")
    refined = made({"neural_ss": [0.13, 0.12, 0.1], "linear": [0.14, 0.13], "narx": [0.2]})
    assert not refined.waits("neural_ss")


def test_a_family_behind_is_not_refined_before_three_are_tried() -> None:
    assert made({"linear": [0.5], "block_oriented": [0.9]}).waits("block_oriented")
    assert not made({"linear": [0.5], "block_oriented": [0.7]}).waits("block_oriented")
    assert not made({"linear": [0.5], "narx": [0.6], "block_oriented": [0.9]}).waits(
        "block_oriented"
    )
    assert not made({"linear": [0.5], "greybox": [0.9]}).waits("greybox")


def test_a_family_that_gains_nothing_twice_waits_for_one_that_gains() -> None:
    stalled = {"neural_ss": [0.1, 0.1, 0.11], "linear": [0.14, 0.13], "narx": [0.2]}
    assert made(stalled).waits("neural_ss")
    assert not made(stalled).waits("linear")
    assert not made({**stalled, "linear": [0.2, 0.19]}).waits("neural_ss")
    assert not made({**stalled, "linear": [0.13, 0.13, 0.13]}).waits("neural_ss")


def test_a_family_that_gains_nothing_twice_in_a_row_waits_for_a_new_one() -> None:
    others = {"linear": [0.9], "narx": [0.9]}
    assert made({**others, "nl_lfr": [0.1, 0.2, 0.1]}).waits("nl_lfr")
    assert not made({**others, "nl_lfr": [0.1, 0.2]}).waits("nl_lfr")
    assert not made({**others, "nl_lfr": [0.3, 0.2, 0.1]}).waits("nl_lfr")
    assert not made({"nl_lfr": [0.1, 0.2, 0.1], **others}).waits("nl_lfr")
    every = {row.name: [0.9] for row in families(simulation(physics=False))}
    assert not made({**{n: v for n, v in every.items() if n != "nl_lfr"},
                     "nl_lfr": [0.1, 0.2, 0.1]}).waits("nl_lfr")  # fmt: skip


def test_the_linear_reference_counts_as_a_tried_family() -> None:
    known = simulation(physics=True)
    outcome = better_each_time("greybox")
    found = search(ExpertAgent, known, 15, outcome)
    trials = tuple(t for t in found if t.family == "greybox")[:2]
    other = next(t for t in found if t.family == "nl_lfr")
    seen = view(known, (*trials, other), "refine")
    assert Allocation.of(seen).objection("greybox")
    assert not Allocation.of(replace(seen, linear=0.9)).objection("greybox")


def test_the_rule_is_relaxed_when_only_two_families_apply(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [row for row in families(simulation(physics=False)) if row.name in ("nl_lfr", "esn")]
    monkeypatch.setattr(agent, "families", lambda facts: rows)
    trials = search(ExpertAgent, simulation(physics=False), 10, better_each_time("nl_lfr"))
    names = [t.family for t in trials]
    assert len(names) == 10
    assert set(names) == {"nl_lfr", "esn"}
    assert names.count("nl_lfr") > 2


def test_the_settings_of_the_best_linear_model_are_no_refinement() -> None:
    known = simulation(physics=False)
    first = baseline(known)
    again = replace(first, number=2, family="linear", title=f"linear state-space: {BEST_LINEAR}")
    other = replace(again, title="linear state-space: saturated inputs")
    assert not Allocation.of(view(known, (first, again), "explore")).objection("linear")
    assert Allocation.of(view(known, (first, other), "explore")).objection("linear")
