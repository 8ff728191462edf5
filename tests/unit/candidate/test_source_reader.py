"""Untrusted sources are read in a process of their own, with limits."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from asia import _source_reader as module
from asia._source import source_facts
from asia._source_reader import _Reader
from asia.candidate import check_source, source_tree
from asia.errors import CandidateError, Reason

PLAIN = "def fit(trajectories, context):\n    return 1\n"
LONG = (PLAIN + "a=b\n" * 16000).encode()


@pytest.fixture
def reader():
    """A process of this test alone."""
    made = _Reader()
    yield made
    made.close()


def pid_of(reader: _Reader) -> int:
    assert reader._process is not None
    return reader._process.pid


def test_the_process_answers_what_a_reading_in_this_process_finds(reader):
    answer, found = reader.ask(PLAIN.encode()), source_facts(PLAIN)
    assert answer is not None
    assert answer["digest"] == found.digest
    assert answer["bare"] == found.bare == PLAIN
    assert answer["defines_fit"]


@pytest.mark.parametrize("name", ["\\N{DIGIT ONE}", "é"])
def test_names_of_characters_and_letters_beyond_ascii_are_read(name):
    check_source(f"{PLAIN}text, é = '{name}', 1\n")


def test_a_source_over_its_processor_time_is_refused_and_the_next_one_read(reader, monkeypatch):
    monkeypatch.setattr(module, "MOST_SECONDS", 0.05)
    assert reader.ask(LONG) == {"refusal": module._REFUSED}
    assert "digest" in reader.ask(PLAIN.encode())


def test_a_source_over_its_memory_is_refused(reader, monkeypatch):
    monkeypatch.setattr(module, "MOST_MB", 48)
    answer = reader.ask(LONG)
    assert answer is not None
    assert "refusal" in answer


def test_the_refusal_is_one_sentence_for_the_user(monkeypatch):
    monkeypatch.setattr(module, "_read", lambda source: module._REFUSED)
    for use in (check_source, source_tree):
        with pytest.raises(CandidateError, match="more than 5 s or 512 MB to read") as caught:
            use(PLAIN)
        assert caught.value.reason is Reason.SYNTAX


def test_a_process_that_was_killed_is_replaced(reader):
    reader.ask(PLAIN.encode())
    first = pid_of(reader)
    os.kill(first, signal.SIGKILL)
    reader._process.wait()
    assert reader.ask(PLAIN.encode()) is not None
    assert pid_of(reader) != first


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_the_process_is_behind_walls_and_has_no_environment(reader):
    reader.ask(PLAIN.encode())
    place = Path(f"/proc/{pid_of(reader)}")
    status = (place / "status").read_text().splitlines()
    assert {"Seccomp:\t2", "NoNewPrivs:\t1"} <= {*status}
    assert (place / "environ").read_bytes() == b""


FORKS = f"""
import os
from asia import _source_reader as module
from asia.candidate import check_source

check_source({PLAIN!r})
first = module._reader._process.pid
child = os.fork()
module._read.cache_clear()
check_source({PLAIN!r})
pid = module._reader._process.pid
if child == 0:
    module._reader.close()
    os._exit(pid == first)
assert os.waitpid(child, 0)[1] == 0
assert pid == first
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_starts_a_process_of_its_own():
    # In a Python of its own: other tests load libraries with threads, which forks must not.
    subprocess.run([sys.executable, "-W", "error", "-c", FORKS], check=True, timeout=60)
