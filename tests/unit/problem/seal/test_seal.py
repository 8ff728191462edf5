from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.data.sources.files import RecordFiles
from asia.data.trajectory import data_digest
from asia.errors import UserError
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Problem
from asia.problem.protocol import TestRule as Rule
from asia.problem.seal import open_test, seal


@pytest.fixture
def tanks() -> Problem:
    return load_problem("two_tanks_sim")


def csv_problem(tmp_path: Path, test_rows: np.ndarray) -> Problem:
    train = np.random.default_rng(0).standard_normal((100, 2))
    for name, rows in (("train", train), ("test", test_rows)):
        lines = ["u,y", *(f"{u!r},{y!r}" for u, y in rows.tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines))
    (tmp_path / "problem.toml").write_text(
        'sampling_time = 1\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\ntest = ["test.csv"]\n'
    )
    return load_problem(tmp_path)


def test_seal_tells_names_lengths_and_digest_only(tanks: Problem) -> None:
    found = seal(tanks)
    records = open_test(tanks)
    assert found.sha256 == data_digest(records)
    assert (found.names, found.lengths) == (("two_tanks_test",), (1024,))
    assert found.shared_samples == 0
    assert not np.array_equal(records[0].y, tanks.train[0].y)


def test_problem_holds_no_test_outputs(tanks: Problem) -> None:
    first = open_test(tanks)[0].y[:3].tobytes()
    held = [t.y.tobytes() + t.u.tobytes() for t in tanks.train]
    held += [a.tobytes() for a in tanks.truth or ()]
    assert all(first not in part for part in held)
    assert not hasattr(tanks.test.source, "y")


def test_changed_test_data_do_not_open(tmp_path: Path) -> None:
    problem = csv_problem(tmp_path, np.random.default_rng(1).standard_normal((60, 2)))
    lock = tmp_path / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)), encoding="utf-8")
    assert len(open_test(load_lock(lock))[0]) == 60
    csv = tmp_path / "test.csv"
    csv.write_text(csv.read_text() + "\n0.0,0.0\n")
    with pytest.raises(UserError, match="changed since they were sealed"):
        open_test(load_lock(lock))


def test_no_test_data(tanks: Problem) -> None:
    bare = replace(tanks, test=replace(tanks.test, source=None))
    assert seal(bare).sha256 is None
    with pytest.raises(UserError, match="has no test data"):
        open_test(bare)


def test_too_short_test_record_is_refused(tanks: Problem) -> None:
    late = replace(tanks, protocol=replace(tanks.protocol, test=Rule(skip=1019)))
    with pytest.raises(UserError, match="leave out 1024"):
        seal(late)
    almost = replace(tanks, protocol=replace(tanks.protocol, test=Rule(skip=1018)))
    assert seal(almost).sha256 is not None


def test_unreadable_test_record_is_refused(tmp_path: Path, tanks: Problem) -> None:
    source = RecordFiles((), (tmp_path / "nowhere.csv",))
    with pytest.raises(UserError, match="no such file"):
        seal(replace(tanks, test=replace(tanks.test, source=source)))


def test_copied_samples_are_counted(tmp_path: Path) -> None:
    train = np.random.default_rng(0).standard_normal((100, 2))
    test = np.random.default_rng(1).standard_normal((60, 2))
    test[20:45] = train[50:75]
    assert seal(csv_problem(tmp_path, test)).shared_samples == 25


def test_rest_is_not_a_copy(tmp_path: Path) -> None:
    test = np.random.default_rng(1).standard_normal((60, 2))
    test[:30] = 0.0
    problem = csv_problem(tmp_path, test)
    train = np.concatenate([problem.train[0].u, problem.train[0].y], axis=1)
    train[:30] = 0.0
    resting = replace(problem.train[0], u=train[:, :1], y=train[:, 1:])
    assert seal(replace(problem, train=(resting,))).shared_samples == 0


def test_nothing_else_reads_the_test_part() -> None:
    root = Path(asia.__file__).parent
    readers = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if re.search(r"\.(records|read)\(\s*(\"test\"|subset)", path.read_text())
    }
    readers -= {p for p in readers if p.startswith("data/sources/")}
    assert readers == {"problem/seal.py", "testing/source.py"}


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="ASIA_DATA_DIR is not set")
def test_real_test_record_opens() -> None:
    problem = load_problem("cascaded_tanks")
    found = seal(problem)
    assert found.lengths == (1024,)
    assert found.shared_samples == 0
    assert data_digest(open_test(problem)) == found.sha256
