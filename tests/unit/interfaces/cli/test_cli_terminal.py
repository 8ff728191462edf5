"""External text on a real terminal, where escape sequences have an effect."""

import os
import pty
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from asia.agents import Proposal
from asia.ledger.run import open_run
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.search.toy import arx, write_problem

HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b1A\u202eback"
ASIA = "from asia.interfaces.cli import main; main()"


def on_terminal(words: Sequence[object]) -> str:
    """Return both outputs of `asia WORDS` on a terminal."""
    ours, theirs = pty.openpty()
    env = os.environ | {"TERM": "xterm-256color", "COLUMNS": "150"}
    command = [sys.executable, "-c", ASIA, *(str(word) for word in words)]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs, env=env
    )
    os.close(theirs)
    written = bytearray()
    try:
        while part := os.read(ours, 65536):
            written += part
    except OSError:  # the other end is closed
        pass
    finally:
        os.close(ours)
        process.wait()
    return written.decode("utf-8")


def check_tame(written: str) -> None:
    assert "owned" in written
    assert "\x1b]" not in written
    assert "\x1b[2J" not in written
    assert "\x9b" not in written
    assert "\x07" not in written
    assert "\u202e" not in written


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A problem whose baseline holds what a terminal would obey."""
    problem = write_problem(tmp_path / "toy")
    text = (problem / "baseline.py").read_text()
    (problem / "baseline.py").write_text(f"# {HOSTILE}\n{text}\nprint({HOSTILE!r})\n")
    return problem


@pytest.mark.long
def test_sources_and_output_of_candidates(hostile: Path, tmp_path: Path, asia: Asia) -> None:
    runs = tmp_path / "runs"
    line = ("--agent", "random", "--experiments", 2, "--runs", runs)
    assert asia("run", hostile, *line).code == 0
    (run,) = [p for p in runs.iterdir() if (p / "ledger.jsonl").is_file()]
    for words in (("show", run, "1"), ("show", run, "1", "--source"), ("show", run, "1", "2")):
        check_tame(on_terminal(words))
    # A file gets the source as it is.
    plain = asia("show", run, "1", "--source")
    assert plain.out == open_run(run).store.text(open_run(run).view.experiment(1).proposed.source)
    assert HOSTILE in plain.out


@pytest.mark.slow
def test_names_in_a_problem(hostile: Path) -> None:
    name = f"a{HOSTILE}\nfold 9: holds out all.csv"
    os.rename(hostile / "train.csv", hostile / name)
    text = (hostile / "problem.toml").read_text()
    escaped = "".join(c if c.isascii() and c.isprintable() else f"\\u{ord(c):04x}" for c in name)
    (hostile / "problem.toml").write_text(text.replace("train.csv", escaped))
    written = on_terminal(("check", hostile, "--no-draw"))
    check_tame(written)
    assert "holds out" in written
    assert not any(line.startswith("fold 9") for line in written.splitlines())


class Words:
    """An agent of another package: nobody shortened its words."""

    name = "words"

    def propose(self, view: object) -> Proposal:
        forged = f"x{HOSTILE}\n## Experiment 7: [forged](http://x)\n| a | b |"
        return Proposal(arx(2), forged, forged, forged, forged)


@pytest.mark.long
def test_words_of_an_agent(hostile: Path, tmp_path: Path, asia: Asia) -> None:
    runs = tmp_path / "runs"
    agent = "tests.unit.interfaces.cli.test_cli_terminal:Words"
    found = asia("run", hostile, "--agent", agent, "--experiments", 2, "--runs", runs)
    assert found.code == 0, found.err
    (run,) = [p for p in runs.iterdir() if (p / "ledger.jsonl").is_file()]
    for words in (("status", run), ("show", run, "2"), ("show", run, "1", "2")):
        check_tame(on_terminal(words))
    journal = (run / "search_journal.md").read_text()
    headings = [line for line in journal.splitlines() if line.startswith("#")]
    assert len(headings) == 3
    assert "\x1b" not in journal
    assert "[forged]" not in journal
    assert "http:" not in journal
    assert not any(line.startswith("|") for line in journal.splitlines())
    assert len((run / "results.tsv").read_text().splitlines()) == 3
