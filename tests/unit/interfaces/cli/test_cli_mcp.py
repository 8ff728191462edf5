import json
import tomllib
from pathlib import Path

import pytest

from asia.interfaces.mcp.config import CLIENTS

from .conftest import Asia


def test_a_missing_extra_is_named(
    asia: Asia, problem: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.interfaces.mcp.is_installed", lambda name: False)
    done = asia("agent", "mcp", problem)
    assert done.code == 2
    assert "pip install '.[mcp]'" in done.err
    assert not Path("runs").exists()


def test_bad_words_are_refused_before_anything_is_written(asia: Asia, problem: Path) -> None:
    for words, answer in (
        (("agent", "mcp", "nowhere"), "no problem 'nowhere'"),
        (("agent", "mcp", problem, "--token-env", "X"), "--token-env belongs to --http"),
        (("agent", "mcp", problem, "--name", "../x"), "--name '../x'"),
        (("agent", "mcp", problem, "--isolation", "none"), "--isolation none"),
        (("agent", "config", "emacs", problem), "there is: claude, codex, gemini"),
        (("agent", "config", "codex", "nowhere"), "no problem 'nowhere'"),
    ):
        done = asia(*words)
        assert (done.code, done.out) == (2, "")
        assert answer in done.err
    assert not Path("runs").exists()


@pytest.mark.parametrize("client", CLIENTS)
def test_a_configuration_is_complete(
    asia: Asia, problem: Path, client: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASIA_DATA_DIR", "data")
    done = asia("agent", "config", client, "toy", "--experiments", 7, "--seed", 3)
    assert done.code == 0
    if client == "codex":
        server = tomllib.loads(done.out)["mcp_servers"]["asia"]
        assert server["default_tools_approval_mode"] == "approve"
        assert server["tool_timeout_sec"] > 45
        assert server["startup_timeout_sec"] >= 60
    else:
        server = json.loads(done.out)["mcpServers"]["asia"]
        assert server["timeout"] > 45_000
        assert server.get("trust") is (True if client == "gemini" else None)
    assert Path(server["command"]).is_absolute()
    runs = str(Path("runs").resolve())
    options = ["--experiments", "7", "--seed", "3", "--runs", runs]
    assert server["args"][-9:] == ["agent", "mcp", str(problem), *options]
    assert server["env"] == {"ASIA_DATA_DIR": str(Path("data").resolve())}
    assert client in done.err.lower()


def test_a_built_in_problem_keeps_its_name(asia: Asia, problem: Path) -> None:
    done = asia("agent", "config", "claude", "two_tanks_sim", "--runs", "elsewhere")
    arguments = json.loads(done.out)["mcpServers"]["asia"]["args"]
    assert arguments[-3:] == ["two_tanks_sim", "--runs", str(Path("elsewhere").resolve())]
