"""A search with `early_stopping = "validation"`: recorded, marked, resumed and interrupted."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import asia
from asia.errors import UserError
from asia.ledger.chain import read_lines
from asia.ledger.events import Started, adapter
from asia.ledger.run import Run, open_run
from asia.ledger.verification import verify
from asia.presentation.exports import journal, results_table
from asia.problem.load import load_problem
from asia.search.run import prepare
from asia.search.settings import SearchSettings

from .toy import Scripted, arx, write_problem

TOLD = arx(2).replace(
    "    return Model(weights)\n",
    "    if context.validation_score is not None:\n"
    "        for scale in (0.9, 1.0):\n"
    "            context.log(scale, context.validation_score(Model(scale * weights)))\n"
    "    return Model(weights)\n",
)
FAILS = TOLD.replace("    return Model(weights)\n", "    raise ValueError('after being told')\n")
AGENT = Scripted((TOLD, FAILS, TOLD.replace("0.9", "0.8")))
MARK = "import ctypes, time; ctypes.CDLL(None).prctl(15, b'{mark}', 0, 0, 0)"


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy", retests=2)


def go(problem: Path, runs: Path) -> Path:
    return asia.run(problem, agent=AGENT, runs=runs, early_stopping="validation").directory


@pytest.mark.slow
def test_it_is_recorded_counted_and_marked(problem: Path, tmp_path: Path) -> None:
    directory = go(problem, tmp_path / "runs")
    assert directory.name == "toy-scripted-s0-validation"
    assert 'early_stopping = "validation"' in (directory / "problem.lock.toml").read_text()
    verify(directory)
    view = open_run(directory).view
    assert view.started.early_stopping == "validation"
    results = [e.result for e in view.finished if e.result]
    assert [r.validation_scores for r in results] == [0, 8, 4, 4]
    assert [[f.validation_scores for f in r.folds] for r in results] == [[0, 0], [2, 2], [], [2, 2]]
    assert view.validation_scores == 16
    assert view.refitted is not None
    assert view.refitted.model is not None
    assert view.v_name == "V (validation early stopping)"
    head = results_table(view).splitlines()[0].split("\t")
    assert head[:2] == ["experiment", "val (validation early stopping)"]
    text = journal(view)
    assert "V is not leak-free and only comparable with V of the same setting; 16 valid" in text
    assert text.count("V (validation early stopping) = ") == 3
    assert text.count(" V = ") == 0


@pytest.fixture(scope="module")
def inner(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root = tmp_path_factory.mktemp("inner")
    return asia.run(
        write_problem(root / "toy"), agent=AGENT, experiments=2, runs=root / "runs",
        early_stopping="inner",
    )  # fmt: skip


@pytest.mark.slow
def test_an_inner_search_keeps_its_name_and_its_words(inner: Run) -> None:
    assert inner.name == "toy-scripted-s0"
    assert inner.view.v_name == "V"
    assert "alidation" not in journal(inner.view) + results_table(inner.view)


@pytest.mark.long
def test_it_resumes_from_every_record(problem: Path, tmp_path: Path) -> None:
    directory = go(problem, tmp_path / "runs")
    once = open_run(directory).view
    whole = [(e.proposed, e.score, e.failure) for e in once.experiments]
    lines = (directory / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    for kept in (len(lines) - 6, len(lines) - 3):  # while one is evaluated, and between two
        (directory / "ledger.jsonl").write_bytes(b"".join(lines[:kept]))
        again = open_run(go(problem, tmp_path / "runs")).view
        assert [(e.proposed, e.score, e.failure) for e in again.experiments] == whole
        assert again.validation_scores == once.validation_scores == 16


@pytest.mark.slow
def test_one_run_holds_one_setting(inner: Run) -> None:
    runs = inner.directory.parent
    first = load_problem(runs.parent / "toy")
    other = SearchSettings(early_stopping="validation").applied(first)
    with pytest.raises(UserError, match=r"protocol\.early_stopping was 'inner', is 'validation'"):
        prepare(other, AGENT.name, seed=0, runs=runs, name=inner.name)
    with pytest.raises(UserError, match="expected inner or validation"):
        SearchSettings(early_stopping="outer").applied(first)


@pytest.mark.slow
def test_a_ledger_without_the_fields_is_of_an_inner_search(inner: Run) -> None:
    for line in read_lines(inner.directory / "ledger.jsonl"):
        body = adapter.dump_python(line.event, mode="json")
        body.pop("early_stopping", None)
        body.pop("validation_scores", None)
        for fold in body.get("folds", []) if not isinstance(line.event, Started) else []:
            fold.pop("validation_scores")
        again = adapter.validate_python(json.loads(json.dumps(body)))
        assert again == line.event
        if isinstance(again, Started):
            assert again.early_stopping == "inner"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "how"),
    [
        ("process", signal.SIGINT),
        ("strongest", signal.SIGKILL),
        pytest.param("process", signal.SIGKILL, marks=pytest.mark.long),
        pytest.param("strongest", signal.SIGINT, marks=pytest.mark.long),
    ],
)
def test_both_workers_end_with_the_search(
    problem: Path, tmp_path: Path, level: str, how: signal.Signals
) -> None:
    fits, scores = (f"{what}{os.getpid()}{level[0]}{how.value}" for what in ("fit", "score"))
    simulating = f"        {MARK.format(mark=scores)}; time.sleep(60)\n"
    slow = TOLD.replace("        n = 2\n", simulating, 1)
    (problem / "baseline.py").write_text(f"{MARK.format(mark=fits)}\n{slow}")
    words = ["run", str(problem), "--experiments", "1", "--early-stopping", "validation"]
    words += ["--isolation", level] if level == "process" else []
    asia_command = str(Path(sys.executable).with_name("asia"))
    process = subprocess.Popen(
        [asia_command, *words], cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    assert wait_for(lambda: living(fits) and living(scores)), "no model was being scored"
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode == (130 if how is signal.SIGINT else -how.value)
    assert wait_for(lambda: not living(fits) and not living(scores)), "a worker lives on"


def wait_for(condition, seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def living(mark: str) -> int:
    count = 0
    for pid in os.listdir("/proc"):
        try:
            text = Path(f"/proc/{pid}/stat").read_text()
        except OSError:
            continue
        count += f"({mark})" in text and text.rpartition(")")[2].split()[0] not in "ZX"
    return count
