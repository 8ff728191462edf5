"""A test file in an encrypted store: what is written, what is removed, and who can open it."""

from __future__ import annotations

import os
import re
import stat
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal
from asia.data.store import key_folder, open_store
from asia.data.trajectory import data_digest
from asia.errors import UserError
from asia.problem.create import NewProblem, init_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_differences, lock_text
from asia.problem.problem import Problem
from asia.problem.seal import check_openable, open_test, seal


def record(length: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((length, 3))


def write(path: Path, rows: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["u,y,extra", *(",".join(map(repr, row)) for row in rows.tolist())]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "keys"
    monkeypatch.setenv("ASIA_KEYS", str(folder))
    return folder


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    return (
        write(tmp_path / "data" / "a.csv", record(200, 0)),
        write(tmp_path / "data" / "b.csv", record(90, 1)),
    )


Make = Callable[..., NewProblem]


@pytest.fixture
def make(tmp_path: Path, files: tuple[Path, Path], keys: Path) -> Make:
    def sealed(**changes: object) -> NewProblem:
        arguments: dict[str, object] = {
            "train": [files[0]],
            "test": [files[1]],
            "inputs": ["u"],
            "outputs": ["y"],
            "sampling_time": 0.5,
            "seal": True,
        }
        return init_problem(tmp_path / "mine", **{**arguments, **changes})  # type: ignore[arg-type]

    return sealed


def test_the_file_moves_and_comes_back_whole(
    make: Make, files: tuple[Path, Path], keys: Path
) -> None:
    plain = files[1].read_bytes()
    made = make()
    assert made.removed == (files[1],)
    assert not files[1].exists()
    assert files[0].exists()
    assert made.store is not None
    (content,) = open_store(made.store, keys)
    assert content.data == plain
    problem = load_problem(made.path)
    (opened,) = open_test(problem)
    assert np.array_equal(opened.y[:, 0], record(90, 1)[:, 1])
    assert opened.name == "b"


def test_no_value_and_no_key_lie_in_the_problem(
    make: Make, files: tuple[Path, Path], keys: Path
) -> None:
    values = [cell.encode() for cell in files[1].read_text().split("\n")[3].split(",")]
    made = make()
    assert made.key is not None
    assert made.key.parent == keys
    assert stat.S_IMODE(made.key.stat().st_mode) == 0o600
    assert stat.S_IMODE(keys.stat().st_mode) == 0o700
    secret = made.key.read_bytes().strip()
    for path in made.path.parent.iterdir():
        assert not any(value in path.read_bytes() for value in (*values, secret))


def test_a_search_needs_no_key_to_commit_the_digest(make: Make, keys: Path) -> None:
    made = make()
    problem = load_problem(made.path)
    (opened,) = open_test(problem)
    assert made.key is not None
    made.key.unlink()
    found = seal(problem)
    assert found.sha256 == data_digest([opened])
    assert (found.names, found.lengths, found.shared_samples) == (("b",), (90,), 0)
    assert found.sha256 in made.path.read_text()


def test_shared_samples_are_counted_before_they_are_hidden(
    make: Make, files: tuple[Path, Path]
) -> None:
    rows = record(90, 1)
    rows[20:45] = record(200, 0)[50:75]
    write(files[1], rows)
    assert seal(load_problem(make().path)).shared_samples == 25


def test_without_the_key_it_says_which_and_where(make: Make, keys: Path, tmp_path: Path) -> None:
    made = make()
    problem = load_problem(made.path)
    assert made.key is not None
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    made.key.rename(elsewhere / made.key.name)
    for attempt in (check_openable, open_test):
        with pytest.raises(UserError) as caught:
            attempt(problem)
        assert made.key.name in str(caught.value)
        assert "nobody can open this test" in str(caught.value)
    assert len(open_test(problem, elsewhere)[0]) == 90


def test_a_colleague_opens_it_from_another_place(make: Make, keys: Path, tmp_path: Path) -> None:
    made = make()
    there = tmp_path / "there" / "mine"
    there.parent.mkdir()
    made.path.parent.rename(there)
    for name in ("a.csv",):
        write(there.parent / "data" / name, record(200, 0))
    assert len(open_test(load_problem(there))[0]) == 90


def test_a_moved_store_is_no_difference_and_another_one_is(make: Make, tmp_path: Path) -> None:
    made = make()
    problem = load_problem(made.path)
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)))
    assert open_test(load_lock(lock))[0].name == "b"
    assert lock_differences(problem, seal(problem), lock) == ()
    other = replace(seal(problem), sha256="0" * 64)
    assert [d.key for d in lock_differences(problem, other, lock)] == ["digests.test"]


@pytest.mark.parametrize("place", ["head", "payload", "cut", "other key", "no store", "text"])
def test_a_damaged_store_or_key_is_reported(make: Make, place: str) -> None:
    made = make()
    assert made.store is not None
    assert made.key is not None
    line, _, payload = made.store.read_bytes().partition(b"\n")
    if place == "head":
        made.store.write_bytes(line.replace(b'"samples":90', b'"samples":91') + b"\n" + payload)
        expected = "was changed after it was sealed"
    elif place == "payload":
        other = b"B" if payload[-9:-8] == b"A" else b"A"
        made.store.write_bytes(line + b"\n" + payload[:-9] + other + payload[-8:])
        expected = "is damaged"
    elif place == "cut":
        made.store.write_bytes(line[:50])
        expected = "is not a sealed test"
    elif place == "other key":
        made.key.write_bytes(b"A" * 44)
        expected = "bring the key that asia init --seal wrote"
    elif place == "no store":
        made.store.unlink()
        expected = "cannot read the sealed test"
    else:
        made.store.write_text("u,y\n1,2\n")
        expected = "is not a sealed test"
    with pytest.raises(UserError, match=expected):
        open_test(load_problem(made.path))


def test_a_store_forged_with_the_key_is_not_the_one_that_was_sealed(
    make: Make, tmp_path: Path, files: tuple[Path, Path]
) -> None:
    made = make()
    write(files[1], record(90, 2))
    other = init_problem(
        tmp_path / "other", train=[files[0]], test=[files[1]], inputs=["u"], outputs=["y"],
        sampling_time=0.5, seal=True,
    )  # fmt: skip
    assert made.store is not None
    assert other.store is not None
    other.store.replace(made.store)
    with pytest.raises(UserError, match="holds other test data"):
        seal(load_problem(made.path))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"inputs": (Signal("extra"),)}, "sealed with inputs u, and the problem has extra"),
        ({"outputs": (Signal("extra"),)}, "sealed with outputs y"),
        ({"sampling_time": 0.25}, r"sealed with sampling_time 0\.5 s"),
    ],
)
def test_other_signals_than_those_sealed(
    make: Make, changes: dict[str, object], expected: str
) -> None:
    problem = load_problem(make().path)
    changed: Problem = replace(problem, **changes)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=expected):
        seal(changed)


def test_nothing_is_removed_unless_the_store_reads_back(
    make: Make, files: tuple[Path, Path], keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.problem.sealing.open_store", lambda store, keys: ())
    with pytest.raises(UserError, match="does not hold what was sealed"):
        make()
    assert files[1].exists()


def test_a_failure_leaves_neither_store_nor_key(
    make: Make,
    files: tuple[Path, Path],
    keys: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("asia.problem.sealing.write_store", full)
    with pytest.raises(UserError, match="No space left"):
        make()
    assert files[1].exists()
    assert not (tmp_path / "mine").exists()
    assert list(keys.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes anywhere")
def test_a_key_that_cannot_be_written(make: Make, files: tuple[Path, Path], keys: Path) -> None:
    keys.mkdir(mode=0o500)
    with pytest.raises(UserError, match="cannot write a key"):
        make()
    assert files[1].exists()


def test_files_that_cannot_be_moved_are_refused(
    make: Make, files: tuple[Path, Path], tmp_path: Path
) -> None:
    link = tmp_path / "link.csv"
    link.symlink_to(files[1])
    for test, expected in (
        ([link], "is a link"),
        ([files[0]], "in both train and test"),
        ([files[1], files[1]], "2 times"),
    ):
        with pytest.raises(UserError, match=expected):
            make(test=test)
    assert files[1].exists()
    assert not (tmp_path / "mine").exists()


def test_other_copies_are_reported(make: Make, files: tuple[Path, Path]) -> None:
    os.link(files[1], files[1].with_name("copy.csv"))
    (files[1].parent / ".git").mkdir()
    made = make()
    assert "other names on this disk" in made.notes[0]
    assert "git repository" in made.notes[1]
    assert files[1].with_name("copy.csv").exists()


def test_a_public_download_keeps_its_plain_file(
    make: Make, files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASIA_DATA_DIR", str(files[1].parent))
    made = make()
    assert made.removed == ()
    assert files[1].exists()
    assert "belongs to a download and stays" in made.notes[0]


def test_files_of_one_name_keep_apart(make: Make, files: tuple[Path, Path], tmp_path: Path) -> None:
    other = write(tmp_path / "more" / "b.csv", record(80, 3))
    made = make(test=[files[1], other])
    assert seal(load_problem(made.path)).names == ("data_b", "more_b")
    assert [len(t) for t in open_test(load_problem(made.path))] == [90, 80]


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"ASIA_KEYS": "/a/keys"}, "/a/keys"),
        ({"XDG_CONFIG_HOME": "/b"}, "/b/asia/keys"),
        ({"XDG_CONFIG_HOME": "not/absolute", "HOME": "/c"}, "/c/.config/asia/keys"),
    ],
)
def test_folder_of_keys(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: str
) -> None:
    for name in ("ASIA_KEYS", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert key_folder() == Path(expected)
    assert key_folder(Path("/mine")) == Path("/mine")


def test_a_store_opens_without_this_package(
    make: Make, files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Open the store by the steps of the documentation."""
    page = (Path(__file__).parents[4] / "docs" / "seal.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    plain = files[1].read_bytes()
    monkeypatch.setenv("HOME", str(tmp_path))
    made = make(keys=tmp_path / ".config" / "asia" / "keys")
    made.path.parent.rename(tmp_path / "mill")
    monkeypatch.chdir(tmp_path)
    exec(textwrap.dedent(code), {})
    assert (tmp_path / "b.csv").read_bytes() == plain
