import fcntl
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger.chain import Chain, in_use

HOLD = """
import sys
from pathlib import Path
from asia.ledger.chain import Chain
with Chain(Path(sys.argv[1])):
    print("holds", flush=True)
    sys.stdin.read()
"""


def test_a_glance_at_the_lock_does_not_keep_a_search_out(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    path.touch()
    with path.open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        threading.Timer(0.03, lambda: fcntl.flock(reader, fcntl.LOCK_UN)).start()
        with Chain(path):
            assert in_use(path)


def test_a_second_search_is_kept_out_and_told_by_whom(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == b"holds\n"
        words = (
            rf"{tmp_path} is in use by another search \(process {process.pid} on "
            rf"{socket.gethostname()}, since 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d\+00:00\); wait"
        )
        with pytest.raises(UserError, match=words):
            Chain(path)
        assert in_use(path)
        process.kill()
    # The lock ends with its holder, whatever the holder left lying about.
    assert (tmp_path / "ledger.holder").exists()
    with Chain(path), pytest.raises(UserError, match=f"process {os.getpid()} "):
        Chain(path)
    assert not (tmp_path / "ledger.holder").exists()
    assert not in_use(path)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"pid": 1}', '{"pid": 1, "x": 2}'])
def test_a_note_of_the_holder_that_cannot_be_read_is_done_without(
    tmp_path: Path, text: str
) -> None:
    path = tmp_path / "ledger.jsonl"
    with Chain(path):
        (tmp_path / "ledger.holder").write_text(text)
        with pytest.raises(UserError, match="in use by another search; wait"):
            Chain(path)


def test_a_ledger_that_cannot_be_opened_is_not_left_locked(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    path.write_bytes(b"{}\n")
    with pytest.raises(UserError, match="event 0"):
        Chain(path)
    assert not in_use(path)
