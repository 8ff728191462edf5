"""asia view on the command line."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces import view as view_room
from asia.interfaces.cli import main
from asia.interfaces.view import require_server
from asia.interfaces.view import server as view_server
from asia.interfaces.view.app import token_path
from asia.interfaces.view.server import serve_view


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["asia", "view", *words])
    with pytest.raises(SystemExit) as raised:
        main()
    return int(raised.value.code or 0)


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, str | None, int]]:
    """Arguments of the server that would have started."""
    found: list[tuple[Path, str | None, int]] = []

    def serve(folder: Path, run: str | None, port: int, *further: object) -> None:
        found.append((folder, run, port))

    monkeypatch.setattr(view_server, "serve_view", serve)
    return found


def test_a_run_a_folder_or_nothing_is_named(
    monkeypatch: pytest.MonkeyPatch, runs: Path, places: list[tuple[Path, str | None, int]]
) -> None:
    for words in (["made", "--runs", str(runs)], [str(runs / "made")]):
        assert run(monkeypatch, *words) == 0
    for words in (["--runs", str(runs), "--port", "0"], [str(runs)]):
        assert run(monkeypatch, *words) == 0
    assert places == [(runs, "made", 8731)] * 2 + [(runs, None, 0), (runs, None, 8731)]


def test_a_run_that_is_not_there_is_a_users_error(
    monkeypatch: pytest.MonkeyPatch, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "none", "--runs", str(runs)) == 2
    assert "no run 'none'" in capsys.readouterr().err
    monkeypatch.chdir(runs)
    assert run(monkeypatch) == 2
    assert "no runs under runs" in capsys.readouterr().err


def test_a_port_that_is_taken_is_named(runs: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port}: Address already in use"):
            serve_view(runs, None, port, print)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    require_server()
    monkeypatch.setattr(view_room, "is_installed", lambda name: False)
    with pytest.raises(UserError, match=r"pip install '\.\[view\]'"):
        require_server()


@pytest.mark.slow
def test_the_address_bears_the_token_and_an_interrupt_ends_it(runs: Path) -> None:
    command = [sys.executable, "-c", "from asia.interfaces.cli import main; main()", "view", "made"]
    command += ["--runs", str(runs), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        address = process.stdout.readline().split()[1]
        assert process.stdout.readline() == "Ctrl-C ends\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert process.stderr.read() == ""
    token = token_path(runs).read_text()
    assert address.startswith("http://127.0.0.1:")
    assert address.endswith(f"/runs/made?token={token}")
