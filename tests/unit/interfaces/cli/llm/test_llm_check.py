"""`asia agent check` with a scripted server."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from asia.interfaces.cli import agent
from tests.unit.agents.fake_llm import PROMPT_TOKENS, REPLY_TOKENS, FakeServer, Told, fake_llm, said
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.search.toy import CRASH, arx

BROKEN = "def fit(trajectories, context:\n    pass\n"
REFUSAL = Told("I cannot help with that.")


@pytest.fixture
def server(problem: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeServer]:
    monkeypatch.setattr(agent, "CHECK_PROBLEM", str(problem))
    monkeypatch.setattr("asia.judge.evaluation.references.BASELINE", arx(1))
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    with fake_llm([]) as server:
        yield server


def kept() -> dict[str, Any]:
    (path,) = Path("runs").glob("llm-check-*/llm-check.json")
    return json.loads(path.read_text())


@pytest.mark.slow
def test_repairs_are_counted_with_what_was_wrong(asia: Asia, server: FakeServer) -> None:
    server.answers = [said(BROKEN), said(arx(2)), said(CRASH), said(arx(3))]
    options = ("--base-url", server.url, "--model", "mine", "--steps", 3, "--json")
    done = asia("agent", "check", *options)
    assert done.code == 0, done.err
    report = json.loads(done.out)
    assert report == kept()
    assert report["verdict"] == "able with repairs"
    assert (report["at_once"], report["repaired"], report["scored"]) == (2, 1, 2)
    assert report["answers"] == 4
    assert report["tokens_a_step"] == pytest.approx((PROMPT_TOKENS + REPLY_TOKENS) * 4 / 3)
    assert "was never closed" in report["wrong"][0]
    assert report["failures"] == ["crash (1 times)"]
    assert report["model"] == "mine"


@pytest.mark.slow
def test_a_model_without_candidates_is_not_able(asia: Asia, server: FakeServer) -> None:
    server.answers = [REFUSAL] * 3 + [said(arx(2))]
    done = asia("agent", "check", "--base-url", server.url, "--steps", 2)
    assert done.code == 3, done.err
    assert "not able" in done.out
    report = kept()
    assert report["without_candidate"] == 1
    assert report["wrong"] == ["the answer has no fenced python block with candidate.py (3 times)"]


@pytest.mark.slow
def test_no_more_is_asked_when_the_time_is_over(asia: Asia, server: FakeServer) -> None:
    server.answers = [said(arx(2)), said(arx(3))]
    done = asia("agent", "check", "--base-url", server.url, "--steps", 2, "--minutes", 0)
    assert done.code == 3, done.err
    assert server.asked == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "asia agent check needs a server or a model"),
        (("--base-url", "http://127.0.0.1:9/v1"), "does not list its models"),
    ],
)
def test_what_cannot_be_asked(
    asia: Asia, server: FakeServer, options: tuple[str, ...], words: str
) -> None:
    done = asia("agent", "check", *options)
    assert done.code == 2
    assert words in done.err
    assert not Path("runs").exists()


def test_a_server_without_models_is_said(asia: Asia, server: FakeServer) -> None:
    server.models = ()
    done = asia("agent", "check", "--base-url", server.url)
    assert done.code == 2
    assert "lists no model" in done.err
