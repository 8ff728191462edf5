"""Proposals while earlier ones run."""

from dataclasses import replace

import pytest

from asia.agents import Agent, AgentView, Proposal, Running
from asia.agents.bayes import BayesAgent, _encode_trial, _study  # pyright: ignore[reportPrivateUsage]
from asia.agents.expert.agent import ExpertAgent
from asia.agents.library.registry import families
from asia.agents.llm.prompt import Task, search_text, task_of
from asia.agents.random import RandomAgent
from asia.candidate import source_digest

from .searches import simulation, view
from .test_llm_prompt import now, trial


def ahead(seen: AgentView, *proposals: Proposal) -> AgentView:
    """The view with these in flight."""
    running = tuple(
        Running(n, p.parent, p.family, p.title, p.hypothesis, p.expected, p.source)
        for n, p in enumerate(proposals, len(seen.trials) + 1)
    )
    known = {source_digest(r.source) for r in (*seen.trials, *running)}
    return replace(
        seen,
        running=running,
        remaining=seen.remaining - len(running),
        is_known=lambda source: source_digest(source) in known,
    )


def several(agent: Agent, seen: AgentView, count: int = 5) -> list[Proposal]:
    found: list[Proposal] = []
    for _ in range(count):
        proposal = agent.propose(ahead(seen, *found))
        assert proposal is not None
        found.append(proposal)
    return found


@pytest.mark.parametrize("make", [ExpertAgent, RandomAgent, BayesAgent])
def test_running_candidates_are_not_proposed_again(make: type) -> None:
    found = several(make(), view(simulation(physics=True), (), "explore"))
    assert len({source_digest(p.source) for p in found}) == 5
    if make is ExpertAgent:
        assert len({p.family for p in found}) == 5


def test_random_draws_the_same_whatever_has_a_result() -> None:
    seen = view(simulation(physics=False), (), "explore")
    found = several(RandomAgent(), seen, 3)
    trials = tuple(
        replace(trial(n), source=p.source, family=p.family) for n, p in enumerate(found, 1)
    )
    assert RandomAgent().propose(replace(seen, trials=trials)) == RandomAgent().propose(
        ahead(seen, *found)
    )


def test_the_expert_goes_to_its_next_move_while_the_first_runs() -> None:
    facts = simulation(physics=True)
    tried = several(ExpertAgent(), view(facts, (), "explore"), 6)
    trials = tuple(
        replace(trial(n, 1 / n), source=p.source, family=p.family, title=p.title)
        for n, p in enumerate(tried, 1)
    )
    moves = several(ExpertAgent(), view(facts, trials, "refine"), 3)
    assert len({p.title for p in moves}) == 3


def test_bayes_counts_running_trials_as_bad_as_the_worst() -> None:
    facts = simulation(physics=False)
    drawn, rows = several(BayesAgent(), view(facts, (), "explore")), families(facts)
    tried = [replace(trial(1), source=p.source, family=p.family) for p in drawn]
    known = [_encode_trial(one, facts, rows) is not None for one in tried]
    found = [p for p, is_read in zip(drawn, known, strict=True) if is_read]
    done = replace(trial(1, 0.3), source=found[0].source, family=found[0].family)
    study = _study(ahead(view(facts, (done,), "explore"), found[1]), rows, 0)
    assert [t.value for t in study.trials] == [0.3, 0.3]
    failed = replace(trial(1, None), source=found[0].source, family=found[0].family)
    study = _study(ahead(view(facts, (failed,), "explore"), found[1]), rows, 0)
    assert [t.value for t in study.trials] == [2.0, 1.0]


def test_a_prompt_lists_running_trials_and_asks_for_another_direction() -> None:
    seen = now(trial(1), trial(2))
    proposal = Proposal("x = 1\n", "cnn", "a convolution", "it is cheap", "better", 2)
    alone, beside = (search_text(v, Task("explore")) for v in (seen, ahead(seen, proposal)))
    assert "Running" not in alone
    assert "another direction" not in alone
    assert '#3 from #2 "cnn" "a convolution": hypothesis "it is cheap"' in beside
    assert "another direction" in beside


def test_a_failure_is_not_mended_twice() -> None:
    seen = now(trial(1), trial(2, None))
    assert task_of(seen, 2) == Task("repair", 2)
    mending = Proposal("x = 1\n", "cnn", "mended", "it is cheap", "better", 2)
    assert task_of(ahead(seen, mending), 2).kind != "repair"
