"""A disk that fills up or cannot be written, and what a search says and keeps."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Evaluated, Proposed
from asia.ledger.index import index_path
from asia.ledger.run import open_run
from asia.presentation.exports import journal
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.ledger.conftest import finished_run

from .toy import CRASH, Scripted, arx, search_toy, write_problem

FULL = """
import json, subprocess, sys
from pathlib import Path
from asia.errors import UserError
from asia.judge.evaluation import references
from asia.ledger.verification import verify
from asia.search.run import prepare, search
from asia.problem.load import load_problem
from tests.unit.search.test_search_faults import AGENT, told
from tests.unit.search.toy import arx

references.LINEAR = arx(2)
problem, disk = Path(sys.argv[1]), sys.argv[2]
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "none", disk], check=True)
said, records = [], []
for kilobytes in (16, 48, 112, 65536):
    subprocess.run(["mount", "-o", f"remount,size={kilobytes}k", disk], check=True)
    try:
        ready = prepare(load_problem(problem), AGENT.name, seed=0, runs=Path(disk) / "runs")
        view = search(ready, AGENT, lambda event, view: None, lambda view: None)
    except UserError as error:
        said.append(str(error))
    ledger = ready.directory / "ledger.jsonl"
    records.append(ledger.read_bytes().count(b"\\n") if ledger.is_file() else 0)
verify(ready.directory)
rows = (ready.directory / "results.tsv").read_text()
hidden = [p.name for p in ready.directory.rglob(".*")]
print(json.dumps([said, records, told(view), rows, hidden]))
"""
READ_ONLY = """
import subprocess, sys
from asia.interfaces.cli import main
runs = sys.argv[1]
subprocess.run(["mount", "--bind", runs, runs], check=True)
subprocess.run(["mount", "-o", "remount,bind,ro", runs], check=True)
for words in (["status"], ["verify"], ["show", "1"], ["run", sys.argv[2], "--name", "new"]):
    sys.argv = ["asia", *words, "--runs", runs]
    try:
        main()
    except SystemExit as end:
        print("exit code", end.code, flush=True)
"""
AGENT = Scripted((arx(2), CRASH, arx(3)))


def told(view) -> list[object]:  # type: ignore[no-untyped-def]
    """Outcomes, as JSON keeps them."""
    return [
        [e.number, e.result.status, e.score.value if e.score else e.failure.detail]
        for e in view.finished
    ]


def in_a_mount_namespace(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run Python as root of its own, where file systems can be mounted; skips where it cannot."""
    enter = ["unshare", "--user", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None or subprocess.run([*enter, "true"], check=False).returncode:
        pytest.skip("no mount namespaces here")
    return subprocess.run(
        [*enter, sys.executable, "-c", script, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[3],
    )


@pytest.fixture
def problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
    return write_problem(tmp_path / "toy")


def untimed(table: str) -> list[list[str]]:
    """The rows of results.tsv without the seconds that an evaluation took."""
    rows = [line.split("\t") for line in table.splitlines()]
    seconds = rows[0].index("seconds")
    return [row[:seconds] + row[seconds + 1 :] for row in rows]


@pytest.mark.long
def test_a_disk_that_fills_up_again_and_again_loses_nothing(problem: Path, tmp_path: Path) -> None:
    ready = prepare(load_problem(problem), AGENT.name, seed=0, runs=tmp_path / "runs")
    undisturbed = search(ready, AGENT, lambda event, view: None, lambda view: None)
    disk = tmp_path / "disk"
    disk.mkdir()
    done = in_a_mount_namespace(FULL, problem, disk)
    assert done.returncode == 0, done.stderr
    said, records, outcomes, rows, hidden = json.loads(done.stdout)
    assert len(said) == 3
    assert all("the disk is full" in s and "repeat the command" in s for s in said)
    assert records == sorted(records)
    assert records[-1] == len(open_run(ready.directory).lines)
    assert outcomes == told(undisturbed)
    assert untimed(rows) == untimed((ready.directory / "results.tsv").read_text())
    assert hidden == []


@pytest.mark.long
def test_a_read_only_directory_can_be_asked_and_not_searched(problem: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=1))
    ready = prepare(loaded, AGENT.name, seed=0, runs=runs)
    search(ready, AGENT, lambda event, view: None, lambda view: None)
    index_path(ready.directory).unlink()
    done = in_a_mount_namespace(READ_ONLY, runs, problem)
    assert "1 of 1 experiments" in done.stdout
    assert "events and" in done.stdout
    assert "exit code 2" in done.stdout
    assert "new/ledger.jsonl could not be written: Read-only file system; make the " in done.stderr
    assert "name another one with --runs" in done.stderr
    assert "Traceback" not in done.stderr


def test_generated_files_that_a_kill_kept_from_being_written_are_made_up_for(
    finished: Path, tmp_path: Path
) -> None:
    rows = (finished / "results.tsv").read_text()
    (finished / "results.tsv").unlink()
    (finished / "search_journal.md").write_text("old")
    half = finished / "artifacts" / f".{'0' * 64}.1-1.new"
    half.write_bytes(b"half")
    search_toy(tmp_path, arx(2), CRASH, arx(2))
    assert (finished / "results.tsv").read_text() == rows
    assert "Experiment 4" in (finished / "search_journal.md").read_text()
    assert not half.exists()


def test_a_process_left_behind_is_told(tmp_path: Path) -> None:
    directory = finished_run(tmp_path / "run")
    store = Store(directory / "artifacts")
    failure = Failure(Reason.FIT_TIMEOUT, "no answer within 20 s", 1)
    events = (
        Proposed(3, 1, "refine", "f", "t", "h", "e", store.put(b"x = 1\n"), "d"),
        Evaluated(3, "timeout", failure, None, 27.0, deadline=True, left_behind=(4242, 4243)),
    )
    with Chain(directory / "ledger.jsonl") as chain:
        for event in events:
            chain.append(event)
    text = journal(open_run(directory).view)
    assert "worker process 4242, 4243 could not be terminated" in text
