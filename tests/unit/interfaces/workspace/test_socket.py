"""The desk on a socket: closing, failures, hanging up."""

import json
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.workspace.server import DeskServer, RunDesk, SearchProgress, SocketDesk


def ends(call: Callable[[], object], seconds: float = 20.0) -> bool:
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def test_a_server_that_never_served_can_be_closed(tmp_path: Path) -> None:
    server = DeskServer(tmp_path / "s", RunDesk(tmp_path))
    assert ends(lambda: server.__exit__(None, None, None))
    assert not (tmp_path / "s").exists()


def test_a_desk_that_hangs_up_is_told_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def once() -> None:
            channel = server.accept()[0]
            channel.recv(1000)
            channel.close()

        threading.Thread(target=once, daemon=True).start()
        with pytest.raises(UserError, match="closed the connection"):
            SocketDesk(path).progress()


def test_every_failure_is_answered(tmp_path: Path) -> None:
    class Broken(RunDesk):
        def progress(self) -> SearchProgress:
            raise RuntimeError("secret path")

    path = tmp_path / "s"
    with DeskServer(path, Broken(tmp_path)):
        with pytest.raises(UserError, match=r"could not answer \(RuntimeError\)"):
            SocketDesk(path).progress()
        with socket.socket(socket.AF_UNIX) as channel:
            channel.settimeout(20.0)
            channel.connect(str(path))
            channel.sendall(b"[" * 100_000 + b"\n")
            assert "error" in json.loads(channel.makefile("rb").readline())


SUBMIT = {"op": "submit", "source": "x = 1", "family": "", "title": "", "hypothesis": "h"}


@pytest.mark.parametrize(
    "sent",
    [
        {**SUBMIT, "expected": "", "fair": True},
        {**SUBMIT, "expected": "", "ticket": "t1"},
        {**SUBMIT, "expected": "", "unheard_of": 1},
        {**SUBMIT, "expected": "", "parent": "3"},
        {"op": "submit", "source": "x = 1"},
        {"op": "source", "experiment": "1"},
        {"op": "progress", "experiment": 1},
        {"op": "run"},
        {"op": ["submit"]},
        {},
    ],
)
def test_a_request_says_what_its_signature_allows_and_no_more(
    tmp_path: Path, sent: dict[str, object]
) -> None:
    with DeskServer(tmp_path / "s", RunDesk(tmp_path)), socket.socket(socket.AF_UNIX) as channel:
        channel.settimeout(20.0)
        channel.connect(str(tmp_path / "s"))
        channel.sendall(json.dumps(sent).encode() + b"\n")
        answer = json.loads(channel.makefile("rb").readline())
    assert answer["error"].startswith("unknown request")
