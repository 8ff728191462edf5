"""The menu of a language model: candidates that run, their schema, choices read back."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from asia.agents import AgentView, Proposal
from asia.agents.expert.agent import ExpertAgent
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.local import LocalServer
from asia.agents.llm.menu import Offer, menu, menu_problem, menu_schema, menu_search
from asia.agents.llm.reply import Answer, Choice, MalformedReplyError, read_choice
from asia.agents.llm.settings import LlmSettings
from asia.candidate import check_source
from asia.errors import UserError
from asia.testing import check_agent

from .fake_llm import FakeServer, Told, fake_llm, said
from .memory import MemoryJournal
from .searches import body, recipe_of, search, simulation, view, windows


def later(phase: str = "refine", *, physics: bool = True) -> AgentView:
    """A search of the expert after six experiments."""
    facts = simulation(physics=physics)
    return view(facts, search(ExpertAgent, facts, 6), phase)


def told(number: int, settings: dict[str, Any] | None = None, reason: str = "made up") -> Told:
    choice = {"number": number, "settings": settings or {}}
    return Told(json.dumps({"reason": reason, "choice": choice}))


def agent(server: FakeServer, proposals: str = "menu", **changes: Any) -> LlmAgent:
    settings = LlmSettings("made-up", server.url, proposals=proposals)  # type: ignore[arg-type]
    made = LlmAgent(replace(settings, **changes))
    made.attach(MemoryJournal())
    return made


@pytest.mark.parametrize("facts", [simulation(physics=True), simulation(physics=False), body()])
def test_every_candidate_is_new_and_can_run(facts: Any) -> None:
    now = view(facts, search(ExpertAgent, facts, 6), "refine")
    offers = menu(now)
    assert 4 <= len(offers) <= 8
    sources = [offer.proposal.source for offer in offers]
    assert len(set(sources)) == len(sources)
    for offer in offers:
        check_source(offer.proposal.source)
        assert not now.is_known(offer.proposal.source)
    assert any(offer.proposal.parent is None for offer in offers)
    assert any(offer.proposal.parent is not None for offer in offers)


def test_new_families_lead_while_the_search_explores() -> None:
    first = menu(later("explore"))[0].proposal
    assert first.parent is None
    assert first.family not in {trial.family for trial in later().trials}
    assert menu(later("refine"))[0].proposal.parent is not None


def every_choice(offers: tuple[Offer, ...]) -> list[Choice]:
    return [
        Choice(number, {name: value}, "made up")
        for number, offer in enumerate(offers, 1)
        for name, values in offer.settings.items()
        for value in values
    ]


def test_a_setting_changes_this_setting_alone() -> None:
    offers = menu(later(physics=False))
    choices = every_choice(offers)
    assert len(choices) > 30
    for choice in choices:
        offer = offers[choice.number - 1]
        ((name, value),) = choice.settings.items()
        made = offer.chosen(choice)
        check_source(made.source)
        assert recipe_of(made) == offer.recipe.changed(**{name: value})
        assert len(made.title) <= 80
        present = offer.settings[name][0]
        assert (made.source == offer.proposal.source) == (repr(value) == repr(present))
    name = next(iter(offers[0].settings))
    for wrong in ({name: "made up"}, {"made_up": 1}, {name: True}):
        with pytest.raises(MalformedReplyError, match="candidate 1 does not offer"):
            offers[0].chosen(Choice(1, wrong, ""))


def test_the_schema_allows_what_the_menu_offers() -> None:
    offers = menu(later(physics=False))
    variants = menu_schema(offers)["properties"]["choice"]["anyOf"]
    assert [v["properties"]["number"] for v in variants] == [
        {"const": n} for n in range(1, len(offers) + 1)
    ]
    for variant, offer in zip(variants, offers, strict=True):
        listed = variant["properties"].get("settings", {"properties": {}})["properties"]
        assert {name: tuple(found["enum"]) for name, found in listed.items()} == offer.settings


def test_the_request_is_short_and_tells_cost_and_evidence() -> None:
    now = later()
    assert now.best is not None
    best = replace(now.best, evidence=("made-up evidence",) * 90)
    trials = tuple(best if trial.number == best.number else trial for trial in now.trials)
    now = replace(now, trials=trials, notes=("made-up note",))
    offers = menu(now)
    text = menu_search(now, offers)
    assert len(text) + len(menu_problem(now.facts)) < 12_000
    assert text.count("made-up evidence") == 12
    for part in ("made-up note", "A fit takes about", f"{len(offers)}. "):
        assert part in text
    for facts in (windows(), body()):
        assert len(menu_problem(replace(facts, description="d" * 10**6))) < 4000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"reason": "a", "choice": {"number": 3, "settings": {"order": 2}}}', (3, {"order": 2})),
        ('<think>{"choice": {"number": 1}}</think> {"choice": {"number": 2}}', (2, {})),
        ('```json\n{"choice": {"number": 2, "settings": []}}\n```', (2, {})),
        ('{"choice": {"number": true}}', None),
        ('{"choice": 3}', None),
        ("```python\ndef fit(t, c):\n    return {}\n```", None),
        ("", None),
    ],
)
def test_choices_are_read(text: str, expected: tuple[int, dict[str, Any]] | None) -> None:
    found = read_choice(text)
    assert (None if found is None else (found.number, found.settings)) == expected


def test_a_choice_becomes_the_proposal_after_a_repair() -> None:
    now = later()
    offers = menu(now)
    name, (present, other, *_) = next(iter(offers[1].settings.items()))
    with fake_llm([told(99), Told("2, of course"), told(2, {name: other}, "because")]) as server:
        made = agent(server).propose(now)
    assert isinstance(made, Proposal)
    assert recipe_of(made).get(name) == other != present
    assert "because" in made.hypothesis
    schema = {"name": "choice", "schema": menu_schema(offers)}
    form = {"type": "json_schema", "json_schema": schema}
    assert [asked["response_format"] for asked in server.asked] == [form] * 3
    assert "the menu has no candidate 99" in server.asked[1]["messages"][-1]["content"]
    assert "no JSON object" in server.asked[2]["messages"][-1]["content"]


def test_both_takes_a_choice_and_a_source() -> None:
    source = "def fit(trajectories, context):\n    return 1\n"
    now = later()
    with fake_llm([told(2), said(source)]) as server:
        chosen, written = (agent(server, "both").propose(now) for _ in range(2))
    assert chosen is not None
    assert written is not None
    assert chosen.source == menu(now)[1].proposal.source
    assert written.source == source
    assert "response_format" not in server.asked[0]
    assert "# Menu" in server.asked[0]["messages"][1]["content"]


def test_the_settings_tell_a_menu_from_free_proposals() -> None:
    free = LlmSettings("made-up", "http://localhost:1/v1")
    assert not {"proposals", "local"} & free.record().keys()
    facts = {"sha256": "00", "sampler": {"top_k": 40}}
    local = replace(free, proposals="menu", local=facts)
    assert LlmSettings.from_record(local.record()) == replace(local, base_url="http://localhost/v1")
    with pytest.raises(UserError, match="--anonymous needs --proposals free"):
        replace(free, anonymous=True, proposals="both")


def test_a_request_longer_than_the_context_is_explained() -> None:
    error = {"message": "9000 tokens", "type": "exceed_context_size_error", "code": 400}
    with (
        fake_llm([Told(status=400, body={"error": error})]) as server,
        pytest.raises(UserError, match=r"longer than the context.*--proposals menu.*9000 tokens"),
    ):
        agent(server, "free").propose(later())


@pytest.mark.long
def test_it_is_an_agent_like_the_others() -> None:
    class Chooser:
        """Takes the candidates of menus in turn."""

        def begin(self) -> None:
            self.numbers = cycle(range(1, 9))

        def ask(self, messages: list[dict[str, str]], schema: Any = None) -> Answer:
            del messages, schema
            return Answer(json.dumps({"choice": {"number": next(self.numbers)}}))

    def make() -> LlmAgent:
        made = LlmAgent(LlmSettings("made-up", "http://localhost:1/v1", proposals="menu"))
        made._client = Chooser()  # type: ignore[assignment]
        return made

    check_agent(make)


def test_weights_that_cannot_be_loaded(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        LocalServer(tmp_path / "model.gguf")
    (tmp_path / "model.gguf").write_bytes(b"made up")
    with pytest.raises(UserError, match=r"the server did not start: .*expected a model in GGUF"):
        LocalServer(tmp_path / "model.gguf")
