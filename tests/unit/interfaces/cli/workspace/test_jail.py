"""asia agent workspace --jail: a program started by hand, in the jail of a command agent."""

import json
import os
import pty
import select
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from asia.judge.sandbox.jail import Jail
from asia.ledger.run import open_run
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.interfaces.workspace.desks import end_searches
from tests.unit.search.toy import arx, write_problem

ASIA = "from asia.interfaces.cli import main; main()"
INSIDE = """
import json, os, subprocess, sys
from pathlib import Path

def there(path):
    return os.path.exists(path)

Path("candidate.py").write_text({candidate!r})
asia = [sys.executable, "-c", {asia!r}]
done = subprocess.run([*asia, "try", "-m", "two lags"], capture_output=True, text=True)
said = dict(
    out=done.stdout, err=done.stderr, ledger=there({ledger!r}), test=there({test!r}),
    rows=Path("results.tsv").read_text(), first=Path("PROGRAM.md").read_text().splitlines()[0],
)
Path("said.json").write_text(json.dumps(said))
sys.exit(7)
"""

needs_jail = pytest.mark.skipif(Jail.why_not() is not None, reason=str(Jail.why_not()))


@pytest.mark.slow
@needs_jail
def test_a_program_in_the_jail_submits_and_sees_nothing_else(
    tmp_path: Path, asia: Asia, capfd: pytest.CaptureFixture[str]
) -> None:
    problem, folder, runs = write_problem(tmp_path / "toy"), tmp_path / "work", tmp_path / "runs"
    run = runs / "toy-workspace-s0"
    test = next(p for p in problem.iterdir() if "test" in p.name)
    words = {"ledger": str(run / "ledger.jsonl"), "test": str(test)}
    program = INSIDE.format(candidate=arx(2), asia=ASIA, **words)
    common = ("agent", "workspace", problem, folder, "--runs", runs)
    try:
        done = asia(*common, "--jail", f"{sys.executable} -c {shlex.quote(program)}")
        assert done.code == 7, done.err
        said = json.loads((folder / "said.json").read_text())
        assert "#02 keep" in said["out"], said["err"]
        assert said["rows"].count("\n") == 3
        assert (said["ledger"], said["test"]) == (False, False)
        assert said["first"].startswith("> **Jail.**")
        started = open_run(run).view.started
        assert started.agent_settings["jail"] == "namespace"
        outside = asia("try", "-m", "from outside", "--dir", folder)
        assert outside.code == 2
        assert "its candidates come from a jail" in outside.err
    finally:
        capfd.readouterr()
        end_searches(run)


def test_an_open_folder_says_so_in_its_first_line(tmp_path: Path, asia: Asia) -> None:
    problem, folder = write_problem(tmp_path / "toy"), tmp_path / "work"
    made = asia("agent", "workspace", problem, folder, "--no-start", "--runs", tmp_path / "runs")
    assert made.code == 0, made.err
    first = (folder / "PROGRAM.md").read_text().splitlines()[0]
    assert first.startswith("> **Open folder, no jail.**")
    refused = asia("agent", "workspace", problem, folder, "--network", "--runs", tmp_path / "runs")
    assert refused.code == 2
    assert "--network belongs to --jail CMD" in refused.err


@needs_jail
@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--jail", "no-such-program"), "cannot be run"),
        (("--jail", ""), "expected the command line"),
        (("--jail", "bash", "--agent-mount", "runs"), "would show the agent the runs"),
    ],
)
def test_a_jail_that_cannot_be(
    tmp_path: Path,
    asia: Asia,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    done = asia("agent", "workspace", write_problem(tmp_path / "toy"), "work", *words)
    assert done.code == 2
    assert complaint in done.err
    assert not Path("work").exists()


@pytest.mark.long
@needs_jail
def test_the_program_has_a_terminal_of_its_own(tmp_path: Path) -> None:
    """Keys reach it, Ctrl-C too, and its terminal is the one that controls it."""
    problem, folder, runs = write_problem(tmp_path / "toy"), tmp_path / "work", tmp_path / "runs"
    (problem / "baseline.py").write_text(arx(1))
    program = (
        "import os, signal, time\n"
        "signal.signal(signal.SIGINT, lambda *a: (os.write(1, b'got it\\n'), os._exit(3)))\n"
        "os.close(os.open('/dev/tty', os.O_RDWR))\n"
        "print('ask' + 'ing', flush=True)\n"
        "print('ready for ' + input(), flush=True)\n"
        "time.sleep(60)\n"
    )
    command = [sys.executable, "-c", ASIA, "agent", "workspace", str(problem), str(folder)]
    command += ["--runs", str(runs), "--jail", f"{sys.executable} -c {shlex.quote(program)}"]
    ours, theirs = pty.openpty()
    try:
        with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs) as process:
            os.close(theirs)
            try:
                shown = _until(ours, b"asking")
                os.write(ours, b"keys\n")
                shown += _until(ours, b"ready for keys")
                os.write(ours, b"\x03")
                assert b"got it" in _until(ours, b"got it"), shown
                assert process.wait(60) == 3
            finally:
                process.kill()
    finally:
        os.close(ours)
        end_searches(runs / "toy-workspace-s0")


def _until(terminal: int, words: bytes) -> bytes:
    shown, end = b"", time.monotonic() + 120
    while words not in shown and (left := end - time.monotonic()) > 0:
        if select.select([terminal], [], [], left)[0]:
            try:
                shown += os.read(terminal, 4096)
            except OSError:
                break
    return shown
