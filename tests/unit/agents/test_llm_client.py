"""The client against a scripted server: caps, retries, the record."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from asia.agents import AgentStoppedError
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.client import ChatClient
from asia.agents.llm.reply import Answer
from asia.agents.llm.settings import LlmSettings
from asia.agents.view import DivergedError, InterruptedWaitError
from asia.errors import UserError

from .fake_llm import PROMPT_TOKENS, REPLY_TOKENS, FakeServer, Told, fake_llm
from .memory import MemoryJournal

KEY = "sk-made-up-0123456789"
ASK = [{"role": "user", "content": "hello"}]
AT_ONCE = {"retry-after": "0"}


def ask_on(asked: ChatClient) -> None:
    while True:
        asked.ask(ASK)


def client(
    server: FakeServer, journal: MemoryJournal, *, network: bool = True, **changes: object
) -> ChatClient:
    settings = replace(LlmSettings("made-up", server.url), **changes)  # type: ignore[arg-type]
    made = ChatClient(settings, journal, KEY, network=network)
    made.begin()
    return made


def test_requests_and_records() -> None:
    journal = MemoryJournal()
    with fake_llm([Told("hi")]) as server:
        asked = client(server, journal, temperature=0.5, seed=3, extra_body={"top_k": 7})
        assert asked.ask(ASK) == Answer("hi")
        assert server.asked == [{
            "model": "made-up", "messages": ASK, "max_tokens": 16384, "temperature": 0.5, "seed": 3,
            "top_k": 7,
        }]  # fmt: skip
        assert server.keys == [f"Bearer {KEY}"]
    (exchange,) = journal.exchanges
    assert (exchange.experiment, exchange.path, exchange.status) == (2, "/v1/chat/completions", 200)
    assert json.loads(journal.get(exchange.request)) == server.asked[0]
    assert exchange.usage is not None
    assert exchange.usage.tokens == PROMPT_TOKENS + REPLY_TOKENS
    assert (exchange.usage.cached_tokens, exchange.usage.cost) == (10, None)
    assert KEY.encode() not in b"".join(journal.blobs.values())


def test_a_key_that_the_server_repeats_is_cut_out() -> None:
    journal = MemoryJournal()
    with fake_llm([Told(f"your key is {KEY}")]) as server:
        assert client(server, journal).ask(ASK).text == "your key is [key]"
    assert KEY.encode() not in b"".join(journal.blobs.values())
    with (
        fake_llm([Told(status=401, body={"error": {"message": f"bad key {KEY}"}})]) as server,
        pytest.raises(UserError, match="refuses the key") as refused,
    ):
        client(server, MemoryJournal()).ask(ASK)
    assert KEY not in str(refused.value)


def test_a_busy_server_is_asked_again_and_every_attempt_recorded() -> None:
    journal = MemoryJournal()
    busy = [Told(status=503, headers=AT_ONCE), Told(status=429, headers=AT_ONCE)]
    with fake_llm([*busy, Told("hi")]) as server:
        assert client(server, journal).ask(ASK).text == "hi"
    assert [e.status for e in journal.exchanges] == [503, 429, 200]
    assert [e.usage is None for e in journal.exchanges] == [True, True, False]


def test_waiting_is_bounded() -> None:
    journal = MemoryJournal()
    with (
        fake_llm([Told("hi"), Told(status=429, headers={"retry-after": "3600"})]) as server,
        pytest.raises(AgentStoppedError, match="does not answer") as stop,
    ):
        ask_on(client(server, journal))
    assert stop.value.reason == "agent"
    assert len(server.asked) == 2


def test_a_user_interrupts_the_waiting() -> None:
    journal = MemoryJournal(interrupt=True)
    with (
        fake_llm([Told(status=429, headers={"retry-after": "100"})]) as server,
        pytest.raises(InterruptedWaitError),
    ):
        client(server, journal).ask(ASK)


def test_a_server_that_is_not_there() -> None:
    journal = MemoryJournal()
    with fake_llm([]) as server:
        pass
    with pytest.raises(UserError, match=r"cannot reach the model.*ConnectError"):
        client(server, journal).ask(ASK)
    assert [e.status for e in journal.exchanges] == [0]


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (
            Told(status=400, body={"error": {
                "message": "Unsupported value: temperature", "param": "temperature",
                "code": "unsupported_value"}}),
            r"does not take this value of temperature: change or leave out --temperature",
        ),
        (Told(status=404), r"does not know the model 'made-up'"),
        (Told(status=422, body=b"<html>\x1b[31mno"), r"refuses the request \(422\)"),
    ],
)  # fmt: skip
def test_a_refusal_is_loud(told: Told, words: str) -> None:
    with fake_llm([told]) as server, pytest.raises(UserError, match=words) as refused:
        client(server, MemoryJournal()).ask(ASK)
    assert "\x1b" not in str(refused.value)


def test_the_token_cap_counts_pending_requests() -> None:
    journal = MemoryJournal()
    cap = 5 * (PROMPT_TOKENS + REPLY_TOKENS)
    with fake_llm([Told("hi")] * 9) as server:
        asked = client(server, journal, max_tokens_total=cap, max_reply_tokens=2 * REPLY_TOKENS)
        with pytest.raises(AgentStoppedError, match="tokens are spent") as stop:
            ask_on(asked)
    assert stop.value.reason == "tokens"
    spent = sum(e.usage.tokens for e in journal.exchanges if e.usage)
    assert 0 < spent <= cap
    assert len(server.asked) == len(journal.exchanges) < 5


def test_the_cost_cap() -> None:
    journal = MemoryJournal()
    prices = {"price_input": 1.0, "price_output": 10.0, "max_reply_tokens": REPLY_TOKENS}
    one = (PROMPT_TOKENS * 1.0 + REPLY_TOKENS * 10.0) / 1e6
    with fake_llm([Told("hi")] * 9) as server:
        asked = client(server, journal, max_cost=3.5 * one, **prices)
        with pytest.raises(AgentStoppedError) as stop:
            ask_on(asked)
    assert stop.value.reason == "cost"
    costs = [e.usage.cost for e in journal.exchanges if e.usage and e.usage.cost]
    assert costs == pytest.approx([one] * len(costs))
    assert len(costs) == 3


def test_an_answer_without_usage_counts_at_its_worst() -> None:
    journal = MemoryJournal()
    body = {"choices": [{"message": {"content": "hi"}, "finish_reason": "stop"}]}
    with fake_llm([Told(body=body)] * 9) as server:
        asked = client(server, journal, max_tokens_total=2500, max_reply_tokens=1000)
        with pytest.raises(AgentStoppedError):
            ask_on(asked)
    assert len(server.asked) == 2


def test_recorded_answers_are_served_first_and_exclusively_in_a_replay() -> None:
    journal = MemoryJournal()
    with fake_llm([Told(status=503, headers=AT_ONCE), Told("one"), Told("two")]) as server:
        first = client(server, journal)
        assert [first.ask(ASK).text for _ in range(2)] == ["one", "two"]
        count = len(journal.events)
        again = client(server, journal)
        assert [again.ask(ASK).text for _ in range(2)] == ["one", "two"]
    again = client(server, journal, network=False)
    assert [again.ask(ASK).text for _ in range(2)] == ["one", "two"]
    assert len(journal.events) == count
    with pytest.raises(DivergedError, match="more than the record holds"):
        again.ask(ASK)
    again.begin()
    with pytest.raises(DivergedError, match="differs from the one on record at character"):
        again.ask([{"role": "user", "content": "hallo"}])


def test_an_answer_that_says_nothing() -> None:
    bodies = (b"not json", [], {"choices": []}, {"choices": [{"message": {"content": None}}]})
    with fake_llm([Told(body=body) for body in bodies]) as server:
        asked = client(server, MemoryJournal())
        assert [asked.ask(ASK).text for _ in bodies] == [""] * 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": ""}, "needs a model"),
        ({"base_url": "localhost:8000"}, "expected http"),
        ({"max_cost": 1.0}, "needs prices"),
        ({"price_input": 1.0}, "give both"),
        ({"extra_body": {"stream": True}}, "'stream'"),
    ],
)
def test_settings_that_make_no_sense(changes: dict[str, object], words: str) -> None:
    with pytest.raises(UserError, match=words):
        replace(LlmSettings("made-up"), **changes)  # type: ignore[arg-type]


def test_the_record_of_the_settings_brings_them_back_without_secrets() -> None:
    settings = LlmSettings(
        "made-up", "http://user:pass@host:1/v1", temperature=0.2, extra_body={"b": 1, "a": [2]},
        anonymous=True, api_key_env="SECRET_PLACE", max_tokens_total=5,
    )  # fmt: skip
    record = settings.record()
    assert "pass" not in str(record)
    again = LlmSettings.from_record(record)
    assert again.record() == record
    assert again.parameters == settings.parameters
    assert again.anonymous


def test_the_limit_of_a_reply_has_two_names() -> None:
    assert "max_completion_tokens" in LlmSettings("made-up").parameters
    assert "max_tokens" in LlmSettings("made-up", "http://localhost:1/v1").parameters


def test_a_missing_key_and_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(UserError, match="OPENAI_API_KEY is not set"):
        LlmAgent(LlmSettings("made-up"))
    LlmAgent(LlmSettings("made-up", "http://localhost:1/v1"))
    monkeypatch.setattr("asia._plugins.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install '\.\[llm\]'"):
        LlmAgent(LlmSettings("made-up", "http://localhost:1/v1"))
