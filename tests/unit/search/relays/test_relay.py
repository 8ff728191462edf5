"""Relays: who proposes when, killed, resumed and replayed at every hand-over.

The agents are the real ones; the evaluations are made up from the source, so that no fit is waited
for.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import asia
from asia.agents import Agent, make_agent
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.settings import LlmSettings
from asia.agents.registry import AGENTS, choose_agent, recorded_agents
from asia.agents.relay import RelayAgent, legs_of, make_runner
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import Evaluation
from asia.judge.scoring.outcome import Score
from asia.ledger.events import HandedOver, Proposed
from asia.ledger.run import Run
from asia.ledger.text import hand_over_text
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.search.decision import Decision
from asia.search.fair_trial import Tried
from asia.search.replay import replay_run
from tests.unit.agents.fake_llm import FakeServer, fake_llm, said
from tests.unit.search.toy import Scripted, arx, write_problem

KEY = "sk-made-up-0123456789"


@pytest.fixture(scope="module")
def judged() -> Iterator[pytest.MonkeyPatch]:
    """Every candidate has the folds of one fit, and a V that its source decides."""
    known: list[Evaluation] = []

    def judge(
        evaluator: Evaluator,
        source: str,
        view: SearchView,
        first: Tried | None = None,
        proposed: object = None,
        confirm: object = None,
        store: object = None,
    ) -> Decision:
        del first, proposed, confirm, store
        best = view.best
        if not known:
            known.append(evaluator.evaluate(arx(2)))
        outcome = known[0].outcome
        assert isinstance(outcome, Score)
        number = int.from_bytes(hashlib.sha256(source.encode()).digest()[:4], "big")
        value = 0.1 + number / 2**32
        lower = best is None or best.score is None or value < best.score.value
        evaluation = replace(known[0], outcome=replace(outcome, value=value))
        return Decision(Tried(source, evaluation), "keep" if lower else "discard")

    def refit(self: Evaluator, source: str, models: object = ()) -> None:
        raise CandidateError(Reason.CRASH, "made up")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.search.loop.decide", judge)
        patch.setattr("asia.search.replay.decide", judge)
        patch.setattr(Evaluator, "refit", refit)
        patch.setenv("MADE_UP_KEY", KEY)
        yield patch


def llm(url: str, cap: float | None = None) -> LlmAgent:
    """cap: USD, where a reply costs 0.2 and may cost 2."""
    settings = LlmSettings("made-up", url, api_key_env="MADE_UP_KEY", max_reply_tokens=2000)
    if cap is not None:
        settings = replace(settings, max_cost=cap, price_input=0.0, price_output=1000.0)
    return LlmAgent(settings)


def relay(url: str) -> RelayAgent:
    """Experiments 1 to 3, 4 and 5, 6 and 7, 8 and 9."""
    legs = [("expert", 3), ("random", 2), ("bayes", 2)]
    return RelayAgent(
        [*(make_runner(make_agent(n), count) for n, count in legs), make_runner(llm(url), None)]
    )


@dataclass(frozen=True)
class Searched:
    run: Run
    problem: Path
    server: FakeServer

    @property
    def url(self) -> str:
        return self.server.url


@pytest.fixture(scope="module")
def searched(
    tmp_path_factory: pytest.TempPathFactory, judged: pytest.MonkeyPatch
) -> Iterator[Searched]:
    root = tmp_path_factory.mktemp("relay")
    problem = write_problem(root / "toy", experiments=9)
    answers = [said(arx(3), family="arx"), said(arx(4), family="arx")] * 8
    with fake_llm(answers) as server:
        run = asia.run(problem, agent=relay(server.url), runs=root / "runs")
        yield Searched(run, problem, server)


def proposals(run: Run) -> list[tuple[int, int, str, str, str]]:
    return [
        (e.number, e.proposed.leg, e.proposed.agent, e.proposed.title, e.proposed.digest)
        for e in run.view.experiments
    ]


def handed_over(run: Run) -> list[tuple[int, int, str, str]]:
    """Experiments before it, leg, agent and reason."""
    found: list[tuple[int, int, str, str]] = []
    before = 0
    for line in run.lines:
        before += isinstance(line.event, Proposed)
        if isinstance(line.event, HandedOver):
            found.append((before, line.event.leg, line.event.agent, line.event.reason))
    return found


@pytest.mark.slow
def test_each_agent_has_its_turn_and_the_ledger_says_so(searched: Searched) -> None:
    view = searched.run.view
    assert view.started.agent == "expert3+random2+bayes2+llm"
    assert [leg.experiments for leg in view.started.legs] == [3, 2, 2, None]
    assert view.started.legs[3].settings["model"] == "made-up"
    assert handed_over(searched.run) == [
        (3, 2, "random", "planned"), (5, 3, "bayes", "planned"), (7, 4, "llm", "planned"),
    ]  # fmt: skip
    assert [(leg, agent) for _, leg, agent, *_ in proposals(searched.run)] == [
        (1, ""), (1, "expert"), (1, "expert"), (2, "random"), (2, "random"),
        (3, "bayes"), (3, "bayes"), (4, "llm"), (4, "llm"),
    ]  # fmt: skip
    assert {exchange.leg for exchange in view.exchanges} == {4}
    verify(searched.run.directory)


@pytest.mark.slow
def test_the_estimator_uses_the_record_of_others_and_says_what_it_cannot(
    searched: Searched,
) -> None:
    said_first = searched.run.view.experiment(6).proposed.hypothesis
    assert "Of the experiments of others it uses #02 (" in said_first
    assert "#05 (" in said_first
    assert "#06" not in searched.run.view.experiment(7).proposed.hypothesis


@pytest.mark.slow
def test_results_name_the_agents(searched: Searched) -> None:
    table = (searched.run.directory / "results.tsv").read_text().splitlines()
    column = table[0].split("\t").index("agent")
    assert [row.split("\t")[column] for row in table[1:]] == [
        "", "expert", "expert", "random", "random", "bayes", "bayes", "llm", "llm",
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leg", "after"),
    [
        (2, False),
        (3, True),
        (4, False),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((2, True), (3, False), (4, True))),
    ],
)
def test_killed_at_a_hand_over_it_goes_on_as_it_would_have(
    searched: Searched, tmp_path: Path, leg: int, after: bool
) -> None:
    """Right before the line of the hand-over is written, and right behind it."""
    name = searched.run.name
    shutil.copytree(searched.run.directory, tmp_path / name)
    place = next(
        i for i, line in enumerate(searched.run.lines)
        if isinstance(line.event, HandedOver) and line.event.leg == leg
    )  # fmt: skip
    ledger = tmp_path / name / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    ledger.write_bytes(b"".join(lines[: place + after]))
    again = asia.run(searched.problem, agent=relay(searched.url), runs=tmp_path)
    assert again.name == name
    assert proposals(again) == proposals(searched.run)
    assert handed_over(again) == handed_over(searched.run)


@pytest.mark.slow
def test_a_replay_asks_every_agent_again(searched: Searched) -> None:
    report = replay_run(searched.run.directory, lambda item: None)
    items = {item.name: item for item in report.items if not item.name.startswith("reference")}
    assert [item.proposal for item in items.values()] == ["same"] * 12
    assert report.agrees
    assert [name for name in items if name.startswith("hand-over")] == [
        "hand-over to random", "hand-over to bayes", "hand-over to llm",
    ]  # fmt: skip
    agents = recorded_agents(searched.run.view.started)
    assert [agent and agent.name for agent in agents] == ["expert", "random", "bayes", "llm"]


@pytest.mark.slow
def test_a_larger_budget_goes_to_the_last_leg(searched: Searched, tmp_path: Path) -> None:
    shutil.copytree(searched.run.directory, tmp_path / searched.run.name)
    searched.server.answers.insert(0, said(arx(5), family="arx"))
    more = asia.run(searched.problem, agent=relay(searched.url), runs=tmp_path, experiments=10)
    assert proposals(more)[:9] == proposals(searched.run)
    assert (more.view.experiment(10).proposed.leg, more.view.experiment(10).proposed.agent) == (
        4, "llm",
    )  # fmt: skip


def go(problem: Path, first: Agent, count: int, second: Agent, experiments: int) -> Run:
    agent = RelayAgent([make_runner(first, count), make_runner(second, None)])
    return asia.run(problem, agent=agent, runs=problem.parent / "runs", experiments=experiments)


@pytest.mark.slow
def test_an_agent_with_nothing_left_hands_over_what_it_had(
    tmp_path: Path, judged: pytest.MonkeyPatch
) -> None:
    problem = write_problem(tmp_path / "toy")
    first, second = Scripted((arx(2),), "first"), Scripted((arx(2), arx(3), arx(4)), "second")
    run = go(problem, first, 3, second, 4)
    assert handed_over(run) == [(2, 2, "second", "exhausted")]
    assert [e.proposed.agent for e in run.view.experiments] == ["", "first", "second", "second"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(AGENTS, "first", lambda: replace(first, sources=(arx(2), arx(4))))
        patch.setitem(AGENTS, "second", lambda: second)
        report = replay_run(run.directory, lambda item: None)
    wrong = {item.name: item.detail for item in report.items if not item.agrees}
    assert wrong == {"hand-over to second": "the agent continues here"}


@pytest.mark.slow
def test_an_agent_that_finds_nothing_hands_over(tmp_path: Path, judged: pytest.MonkeyPatch) -> None:
    """Patience counts anew for the next one."""
    problem = write_problem(tmp_path / "toy")
    toml = problem / "problem.toml"
    toml.write_text(toml.read_text() + "patience = 2\n")
    sources = tuple(arx(2).replace("float(n)", f"{i} * n") for i in range(30))
    first, second = Scripted(sources, "first"), Scripted(sources, "second")
    run = go(problem, first, 25, second, 30)
    places = handed_over(run)
    assert [(leg, agent, reason) for _, leg, agent, reason in places] == [
        (2, "second", "saturated")
    ]
    assert run.view.stopped is not None
    assert run.view.stopped.reason == "saturated"
    assert len(run.view.experiments) >= places[0][0] + 2


@pytest.mark.slow
def test_each_leg_has_its_own_cap(tmp_path: Path, judged: pytest.MonkeyPatch) -> None:
    """A leg with 2.3 USD has two replies."""
    problem = write_problem(tmp_path / "toy")
    with fake_llm([said(arx(order), family="arx") for order in range(2, 12)]) as server:
        agent = RelayAgent([
            make_runner(llm(server.url, 2.3), 5),
            make_runner(Scripted((arx(20),) * 9, "between"), 1),
            make_runner(llm(server.url, 2.3), None),
        ])  # fmt: skip
        run = asia.run(problem, agent=agent, runs=tmp_path / "runs", experiments=9)
    assert [(after, reason) for after, *_, reason in handed_over(run)] == [
        (3, "cost"), (6, "planned"),
    ]  # fmt: skip
    assert [exchange.leg for exchange in run.view.exchanges] == [1, 1, 3, 3]
    assert run.view.stopped is not None
    assert (len(run.view.experiments), run.view.stopped.reason) == (8, "cost")
    detail = run.view.handed_over[0].detail
    assert detail.startswith("0.4000 USD are spent")
    assert f"({detail})" in hand_over_text(run.view.handed_over[0])


def test_legs_that_do_not_fit_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", experiments=6)
    for text, words in (
        ("expert*5+bayes*5", r"expert\*5 \+ bayes\*5 = 10 experiments, and the search has 6: ask "),
        ("expert*6+bayes", "bayes needs one more"),
        ("expert+bayes*2", r"Write expert\*N"),
        ("expert*0+bayes", "expected a number of experiments"),
        ("expert*2+expert", "expert follows itself"),
        ("expert*2+", "expected agents"),
        ("expert*2+nobody", "no agent 'nobody'"),
    ):
        with pytest.raises(UserError, match=words):
            asia.run(problem, agent=text, runs=tmp_path / "runs")
    with pytest.raises(UserError, match="leave out the number of the last leg"):
        asia.run(problem, agent="expert*2+bayes*2", runs=tmp_path / "runs", experiments=6)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_another_relay_is_another_search(searched: Searched) -> None:
    other = RelayAgent(
        [make_runner(make_agent("expert"), 3), make_runner(make_agent("bayes"), None)]
    )
    runs, name = searched.run.directory.parent, searched.run.name
    with pytest.raises(UserError, match=r"has agent expert3\+random2\+bayes2\+llm, not expert3"):
        asia.run(searched.problem, agent=other, runs=runs, name=name, guard=True)


def test_a_relay_by_name() -> None:
    agent = choose_agent("expert*5+random-paper*2+bayes").agent
    assert agent.name == "expert5+random-paper2+bayes"
    assert [leg.experiments for leg in legs_of(agent)] == [5, 2, None]
    assert legs_of(make_agent("expert")) == ()
