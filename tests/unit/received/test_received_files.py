"""Run folders with links, pipes, sockets, devices, huge and deep files in place of ASIA's own: each
command ends with a sentence, reads and writes nothing outside the run, and never waits."""

from __future__ import annotations

import os
import shutil
import socket
import stat
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import asia
from asia.errors import UserError
from asia.interfaces.view.followed import RunFolder
from asia.ledger.folder import check_run_folder
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import unpainted
from tests.unit.search.toy import Scripted, write_problem

SECRET = "the-secret-of-somebody-else"
HUGE = 1 << 40


@dataclass(frozen=True)
class Place:
    """A copy of a finished run, and what lies beside it."""

    directory: Path
    outside: Path
    """A folder of the user with one secret file."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("finished")
    loaded = load_problem(write_problem(root / "toy"))
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=1))
    agent = Scripted(())
    ready = prepare(loaded, agent.name, seed=0, runs=root / "runs", name="gift")
    search(ready, agent, lambda event, view: None, lambda view: None)
    with unpainted():
        assert command_line("report", ready.directory).code == 0
    assert command_line("steer", ready.directory, "--note", "hello").code == 0
    return ready.directory


@pytest.fixture
def place(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ASIA_RUNS", raising=False)
    shutil.copytree(finished, tmp_path / "runs" / "gift")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text(f"{SECRET}\n")
    return Place(tmp_path / "runs" / "gift", outside)


def link(path: Path, outside: Path) -> None:
    path.symlink_to(outside / "secret")


def link_to_folder(path: Path, outside: Path) -> None:
    path.symlink_to(outside)


def broken_link(path: Path, outside: Path) -> None:
    path.symlink_to(outside / "nothing")


def circle(path: Path, outside: Path) -> None:
    path.symlink_to(path)


def pipe(path: Path, outside: Path) -> None:
    os.mkfifo(path)


def unix_socket(path: Path, outside: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # the path of a socket is short
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
    finally:
        os.chdir(here)


def device(path: Path, outside: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 5))  # /dev/zero
    except PermissionError:
        pytest.skip("only root can make a device")


def folder(path: Path, outside: Path) -> None:
    path.mkdir()


def huge(path: Path, outside: Path) -> None:
    path.touch()
    try:
        os.truncate(path, HUGE)
    except OSError:
        pytest.skip("this file system has no sparse files of 1 TiB")


KINDS = (link, link_to_folder, broken_link, circle, pipe, unix_socket, device, folder, huge)
FILES = ("ledger.jsonl", "ledger.holder", "problem.lock.toml", "error.txt", "results.tsv")
FOLDERS = ("artifacts", "control", "report", "export")
COMMANDS = (
    ("status",), ("status", "--json"), ("show",), ("report",), ("verify",), ("verify", "--replay"),
    ("validate",), ("validate", "--repeat"), ("export", "--to", "numpy"),
    ("unseal", "--yes"), ("steer", "--note", "hello"),
)  # fmt: skip


def put(make: Callable[[Path, Path], None], path: Path, place: Place) -> None:
    """Replace a file or folder of the run."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif os.path.lexists(path):
        path.unlink()
    path.parent.mkdir(parents=True, exist_ok=True)
    make(path, place.outside)


def refused(place: Place, *words: str) -> None:
    """The command ends with one sentence, and nothing came from or went to the outside."""
    done = command_line(words[0], place.directory, *words[1:])
    assert done.code == 2, (words, done.out)
    assert "Traceback" not in done.err
    assert done.err.splitlines()[-1].startswith("asia: "), done.err
    assert SECRET not in done.out + done.err
    untouched(place)


def untouched(place: Place) -> None:
    assert [path.name for path in place.outside.iterdir()] == ["secret"]
    assert (place.outside / "secret").read_text() == f"{SECRET}\n"


@pytest.mark.long
@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize("name", FILES)
def test_each_command_refuses_another_thing_in_place_of_a_file(
    name: str, make: Callable[[Path, Path], None], place: Place
) -> None:
    if make is huge and name in ("results.tsv", "ledger.jsonl"):
        pytest.skip("these are not read at once")
    put(make, place.directory / name, place)
    for words in COMMANDS:
        refused(place, *words)
    with pytest.raises(UserError):
        asia.open_run(place.directory)
    (listed,) = RunFolder(place.directory.parent).listed() or (None,)
    assert listed is None or listed.trouble


@pytest.mark.long
@pytest.mark.parametrize("make", [make for make in KINDS if make is not folder])
@pytest.mark.parametrize("name", FOLDERS)
def test_each_command_refuses_another_thing_in_place_of_a_folder(
    name: str, make: Callable[[Path, Path], None], place: Place
) -> None:
    put(make, place.directory / name, place)
    for words in COMMANDS:
        refused(place, *words)


@pytest.mark.parametrize("make", [make for make in KINDS if make not in (folder, huge)])
@pytest.mark.parametrize("name", ["control/pause", "control/queue", "report/progress.png"])
def test_each_command_refuses_another_thing_below_a_folder(
    name: str, make: Callable[[Path, Path], None], place: Place
) -> None:
    put(make, place.directory / name, place)
    for words in COMMANDS[:4]:
        refused(place, *words)


@pytest.mark.long
def test_a_huge_ledger_is_refused_at_its_first_hole(place: Place) -> None:
    os.truncate(place.directory / "ledger.jsonl", HUGE)
    for words in COMMANDS:
        refused(place, *words)
    put(huge, place.directory / "ledger.jsonl", place)
    for words in COMMANDS:
        refused(place, *words)


def test_a_deep_folder_is_refused(place: Place) -> None:
    deepest = place.directory / "control"
    for _ in range(200):
        deepest = deepest / "d"
        deepest.mkdir()
    refused(place, "status")


def test_many_files_are_refused(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asia.ledger.folder._MOST_ENTRIES", 20)
    for k in range(21):
        (place.directory / "report" / f"{k}.png").touch()
    refused(place, "status")


@pytest.mark.long
@pytest.mark.parametrize("make", KINDS)
def test_an_artifact_that_is_another_thing_is_not_read(
    make: Callable[[Path, Path], None], place: Place
) -> None:
    """The source, the model and the simulation of the experiment, each in turn."""
    view = open_run(place.directory).view
    assert view.best is not None
    assert view.best.result is not None
    fold = view.best.result.folds[0]
    for digest, commands in (
        (view.best.proposed.source, ("show", "validate", "export", "report")),
        (fold.model, ("validate", "export")),
        (fold.y_hat, ("validate", "report")),
    ):
        path = place.directory / "artifacts" / digest
        kept = path.read_bytes()
        put(make, path, place)
        refused(place, "verify")
        for command in commands:
            words = ("--to", "numpy", "--model", "ensemble") if command == "export" else ()
            with unpainted():
                done = command_line(command, place.directory, *words)
            assert done.code in (0, 2)
            assert "Traceback" not in done.err
            assert SECRET not in done.out + done.err
            assert digest in done.out + done.err, (command, done.err)
        put(lambda path, _, kept=kept: path.write_bytes(kept) and None, path, place)
    untouched(place)


def test_an_artifact_checked_by_a_helper_is_not_read_either(place: Place) -> None:
    """`verify` of a long run reads artifacts in processes of its own."""
    from asia.ledger.artifacts import Artifacts

    for make in (link, pipe, huge):
        with Artifacts(place.directory / "artifacts") as artifacts:
            for k in range(600):
                digest = f"{k:064x}"
                put(make, place.directory / "artifacts" / digest, place)
                artifacts.add(digest, k)
            with pytest.raises(UserError, match="event 0 of"):
                artifacts.check()


def test_a_database_beside_the_ledger_is_never_opened(place: Place) -> None:
    for name in ("index.sqlite", "index.sqlite-journal", "index.sqlite-wal"):
        (place.directory / name).symlink_to(place.outside / "secret")
    assert command_line("status", place.directory).code == 0
    untouched(place)


def test_exports_follow_no_link(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """The link in place of the target's folder is moved aside."""
    from asia.export.pipeline import _put

    (place.directory / "export").mkdir()
    (place.directory / "export" / "numpy").symlink_to(place.outside)
    _put(place.directory / "export" / "numpy", {"model.py": b"1", "inner/file": b"2"})
    assert (place.directory / "export" / "numpy" / "model.py").read_bytes() == b"1"
    assert (place.directory / "export" / "numpy" / "inner" / "file").read_bytes() == b"2"
    untouched(place)


def test_a_neighbour_that_is_no_run_does_not_hold_a_command_up(place: Place) -> None:
    """Commands look for other runs in the same folder."""
    for k, make in enumerate(KINDS):
        other = place.directory.parent / f"other{k}"
        other.mkdir()
        try:
            make(other / "ledger.jsonl", place.outside)
        except pytest.skip.Exception:
            continue
    assert command_line("status", "gift").code == 0
    assert RunFolder(place.directory.parent).listed()
    assert command_line("unseal", "gift", "--yes").code == 0


def test_a_huge_data_file_of_a_lock_is_not_read(place: Place, tmp_path: Path) -> None:
    """A lock names its data by path; the digest would come too late."""
    lock = place.directory / "problem.lock.toml"
    text = lock.read_text()
    named = next(line for line in text.splitlines() if line.startswith("train = ["))
    lock.write_text(text.replace(named, f'train = ["{tmp_path / "huge.csv"}"]', 1))
    huge(tmp_path / "huge.csv", place.outside)
    refused(place, "report")


def test_a_ledger_of_deep_brackets_is_refused(place: Place) -> None:
    """Valid in its hashes, and too deep for a parser."""
    from asia.ledger.chain import BEGIN, _line

    path = place.directory / "ledger.jsonl"
    line, head = _line(BEGIN.seq, BEGIN.head, "now", {"event": "piece", "text": "[", "more": True})
    deep, _ = _line(BEGIN.seq, head, "now", {"event": "piece", "text": "]", "more": False})
    path.write_bytes(line + deep)
    refused(place, "status")


def test_names_in_a_page_are_quoted_for_a_shell(place: Place) -> None:
    from asia.ledger.chain import BEGIN, Chain, encode, read_lines
    from asia.ledger.events import Started

    path, at, written = place.directory / "ledger.jsonl", BEGIN, b""
    for line in list(read_lines(path)):
        event = line.event
        if isinstance(event, Started):
            event = replace(event, agent="x; touch marker", run="y $(touch marker)")
        raw = encode(at, event)
        written, at = written + raw, at.behind(raw)
    path.write_bytes(written)
    with Chain(path) as chain:
        assert chain.view.started.agent == "x; touch marker"
    with unpainted():
        assert command_line("report", place.directory).code == 0
    page = (place.directory / "report" / "report.html").read_text()
    assert "--agent &#39;x; touch marker&#39;" in page


def test_an_own_run_passes(place: Place) -> None:
    check_run_folder(place.directory)
    assert command_line("status", "gift").code == 0
    assert command_line("verify", "gift").code == 0
