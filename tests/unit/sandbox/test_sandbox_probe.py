import os

import pytest

from asia.errors import SandboxError
from asia.sandbox import Isolation, Limits, open_worker, probe
from asia.sandbox._channel import printable


def fake_bwrap(tmp_path, monkeypatch, script: str) -> None:
    program = tmp_path / "bwrap"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))


def test_without_bubblewrap_the_level_is_process_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    found = probe()
    assert found.level is Isolation.PROCESS
    assert any("bubblewrap is not installed" in note for note in found.notes)
    assert any("landlock" in note for note in found.notes)
    with pytest.raises(SandboxError):
        open_worker(Isolation.NAMESPACE, Limits(1.0, 1.0, 1024))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo bubblewrap 0.4.1", "0.8 or newer"),
        (
            'if [ "$1" = --version ]; then echo bubblewrap 0.9.0; exit; fi\n'
            "echo 'bwrap: No permissions to create new namespace' >&2; exit 1",
            "No permissions to create new namespace",
        ),
    ],
)
def test_a_bubblewrap_that_cannot_work_is_named(tmp_path, monkeypatch, script, words):
    fake_bwrap(tmp_path, monkeypatch, script)
    found = probe()
    assert found.level is Isolation.PROCESS
    assert any(words in note for note in found.notes)


def test_a_bubblewrap_that_fails_at_once_is_a_sandbox_error(tmp_path, monkeypatch):
    fake_bwrap(tmp_path, monkeypatch, "echo 'bwrap: broken' >&2; exit 1")
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(SandboxError, match="bwrap: broken"):
        open_worker(Isolation.NAMESPACE, Limits(1.0, 1.0, 1024))
    assert len(os.listdir("/proc/self/fd")) == before


def test_untrusted_bytes_become_plain_text():
    data = b"a\x1b[2J\x00b\tc\r\nd\xff\xe2\x80\xae"
    assert printable(data) == "a[2Jb\tc\nd\ufffd"
