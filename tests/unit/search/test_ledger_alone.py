"""A ledger that was handed on without its artifacts is read as far as it goes."""

import os
import shutil
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.ledger.run import Run, open_run
from asia.ledger.verification import verify
from asia.search.replay import replay_run
from tests.unit.interfaces.cli.conftest import command_line

RUNS = Path(os.environ.get("ASIA_DATA_DIR", "")) / "runs"
NANODRONE = "nanodrone-workspace"


@pytest.fixture(scope="module")
def bare(finished_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    runs = shutil.copytree(finished_once / "runs", tmp_path_factory.mktemp("bare") / "runs")
    (directory,) = runs.iterdir()
    shutil.rmtree(directory / "artifacts")
    return open_run(directory)


@pytest.mark.slow
def test_status_and_verify_read_it(bare: Run) -> None:
    where = ("--runs", str(bare.directory.parent))
    assert "#02 keep" in command_line("status", bare.name, *where).out
    done = command_line("verify", bare.name, *where)
    assert done.code == 0
    assert (
        "no artifacts checked: sources, models and simulations are not in this folder" in done.out
    )
    with pytest.raises(UserError, match="a ledger without artifacts"):
        verify(bare.directory)


def test_show_tells_all_but_the_source(bare: Run) -> None:
    where = ("--runs", str(bare.directory.parent))
    done = command_line("show", bare.name, "2", *where)
    assert done.code == 0
    assert "V = " in done.out
    assert "candidate.py and its output are not here" in done.out
    source = command_line("show", bare.name, "2", "--source", *where)
    assert source.code == 2
    assert "a ledger without artifacts" in source.err


@pytest.mark.slow
def test_the_report_has_the_picture_that_needs_none(bare: Run) -> None:
    done = command_line("report", bare.name, "--runs", str(bare.directory.parent))
    assert done.code == 0
    names = [Path(line).name for line in done.out.splitlines()]
    assert names == ["report.html", "progress.png", "progress.pdf"]
    assert "other pictures left out: they need simulations" in done.err


def test_a_replay_says_what_it_needs(bare: Run) -> None:
    with pytest.raises(UserError, match="restore the folder artifacts"):
        replay_run(bare.directory, lambda item: None)


@pytest.mark.slow
@pytest.mark.skipif(not (RUNS / NANODRONE).is_dir(), reason="no recorded runs in ASIA_DATA_DIR")
def test_the_recorded_ledger_of_the_nanodrone_is_read(tmp_path: Path) -> None:
    directory = tmp_path / NANODRONE
    directory.mkdir()
    for name in ("ledger.jsonl", "problem.lock.toml"):
        (directory / name).write_bytes((RUNS / NANODRONE / name).read_bytes())
    for command in ("status", "show", "report", "verify"):
        assert command_line(command, NANODRONE, "--runs", str(tmp_path)).code == 0
    assert command_line("verify", "--replay", NANODRONE, "--runs", str(tmp_path)).code == 2
