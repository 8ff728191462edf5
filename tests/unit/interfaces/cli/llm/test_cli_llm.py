"""Options of `asia run --agent llm`, and what goes wrong before a model is asked."""

from pathlib import Path

import pytest

from asia.ledger.run import open_run
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.search.toy import arx

LOCAL = ("--agent", "llm", "--model", "made-up", "--base-url", "http://127.0.0.1:9/v1")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--agent", "llm"), "needs a model"),
        (("--agent", "llm", "--model", "m"), "OPENAI_API_KEY is not set"),
        ((*LOCAL, "--prices", "1"), "expected two numbers"),
        ((*LOCAL, "--extra-body", "[1]"), "expected a JSON object"),
        ((*LOCAL, "--max-cost", "1"), "needs prices"),
        (("--anonymous",), "--anonymous is for --agent llm"),
        (("--llm-seed", "0"), "--llm-seed is for --agent llm"),
    ],
)
def test_what_cannot_be(
    asia: Asia, problem: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], words: str
) -> None:
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    done = asia("run", problem, *options)
    assert done.code == 2
    assert words in done.err
    assert not Path("runs").exists()


@pytest.mark.slow
def test_settings_are_on_record_and_the_model_is_not_asked_for_the_baseline(
    asia: Asia, problem: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
    options = (
        *LOCAL, "--temperature", 0.5, "--llm-seed", 3, "--extra-body", '{"top_k": 7}',
        "--max-reply-tokens", 99, "--anonymous", "--experiments", 1,
    )  # fmt: skip
    done = asia("run", problem, *options)
    assert done.code == 0, done.err
    run = open_run(Path("runs/toy-llm-s0"))
    assert run.view.started.agent_settings == {
        "model": "made-up", "base_url": "http://127.0.0.1:9/v1", "temperature": "0.5",
        "seed": "3", "extra_body": '{"top_k": 7}', "max_reply_tokens": "99", "repairs": "2",
        "anonymous": "true",
    }  # fmt: skip
    assert "openai" in run.view.started.environment
    more = asia("run", problem, *options[:-1], 2)
    assert more.code == 2
    assert "cannot reach the model at http://127.0.0.1:9/v1" in more.err
