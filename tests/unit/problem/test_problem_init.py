from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.data.sources.files import RecordFiles
from asia.errors import UserError
from asia.problem.create import init_problem
from asia.problem.load import load_problem
from asia.problem.seal import open_test

Record = Callable[[int, int], str]


@pytest.fixture
def data(tmp_path: Path, record: Record) -> Path:
    for seed, name in enumerate(("a", "b", "c")):
        (tmp_path / f"{name}.csv").write_text(record(200, seed))
    return tmp_path


def make(data: Path, **changes: Any) -> Path:
    arguments: dict[str, Any] = {
        "train": [data / "a.csv", data / "b.csv"],
        "test": [data / "c.csv"],
        "inputs": ["u"],
        "outputs": ["y"],
        "sampling_time": 0.1,
    }
    return init_problem(data / "mine", **{**arguments, **changes}).path


def test_new_problem_loads(data: Path) -> None:
    path = make(data)
    assert path == data / "mine" / "problem.toml"
    problem = load_problem(data / "mine")
    assert problem.name == "mine"
    assert [t.name for t in problem.train] == ["a", "b"]
    assert problem.test.source == RecordFiles((data / "a.csv", data / "b.csv"), (data / "c.csv",))
    assert 'train = ["../a.csv", "../b.csv"]' in path.read_text()
    assert "plain English" in problem.description
    assert sorted(p.name for p in data.iterdir()) == ["a.csv", "b.csv", "c.csv", "mine"]


def test_last_part_is_sealed(data: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    keys = tmp_path_factory.mktemp("keys")
    path = make(data, train=[data / "a.csv"], test=[], seal_fraction=0.2, keys=keys)
    problem = load_problem(path)
    assert [len(t) for t in problem.train] == [160]
    original = np.loadtxt(data / "a.csv", delimiter=",", skiprows=1)
    (sealed,) = open_test(problem, keys)
    assert np.array_equal(problem.train[0].y[:, 0], original[:160, 2])
    assert np.array_equal(sealed.y[:, 0], original[160:, 2])
    assert sealed.name == "a_sealed"
    names = sorted(p.name for p in path.parent.iterdir())
    assert names == ["a_train.csv", "description.md", "problem.toml", "test.sealed"]


def test_no_test_data_is_allowed(data: Path) -> None:
    assert load_problem(make(data, test=[])).test.source is None


def test_data_in_other_folders_are_named_by_absolute_path(data: Path, record: Record) -> None:
    path = init_problem(
        data / "deep" / "mine",
        train=[data / "a.csv"],
        test=[],
        inputs=["u"],
        outputs=["y"],
        sampling_time=0.1,
    ).path
    assert str(data / "a.csv") in path.read_text()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"inputs": ["v"]}, "no column 'v'"),
        ({"inputs": []}, "--inputs is empty"),
        ({"outputs": ["u"]}, "signal 'u' is named 2 times"),
        ({"sampling_time": 0.0}, "sampling_time is 0.0, expected a number above 0"),
        ({"train": []}, "names no training data"),
        ({"test": [], "seal_fraction": 0.9}, "expected more than 0 and at most 0.5"),
        ({"test": [], "seal_fraction": 0.01}, "the past window alone takes 10"),
    ],
)
def test_bad_wishes_write_nothing(data: Path, changes: dict[str, Any], expected: str) -> None:
    before = sorted(data.rglob("*"))
    with pytest.raises(UserError) as caught:
        make(data, **changes)
    assert expected in str(caught.value)
    assert sorted(data.rglob("*")) == before


def test_refused_wish_leaves_no_parent_directories(data: Path) -> None:
    with pytest.raises(UserError, match="in both train and test"):
        init_problem(
            data / "new" / "deep" / "mine",
            train=[data / "a.csv"],
            test=[data / "a.csv"],
            inputs=["u"],
            outputs=["y"],
            sampling_time=0.1,
        )
    assert not (data / "new").exists()


def test_too_short_record_writes_nothing(data: Path, record: Record) -> None:
    (data / "a.csv").write_text(record(40, 0))
    with pytest.raises(UserError, match="at least 50"):
        make(data)
    assert not (data / "mine").exists()


def test_test_record_that_cannot_be_scored_writes_nothing(data: Path, record: Record) -> None:
    (data / "c.csv").write_text(record(10, 2))
    with pytest.raises(UserError, match="test record 'c' has 10 samples"):
        make(data)
    assert not (data / "mine").exists()


def test_constant_output_writes_nothing(data: Path) -> None:
    for name in ("a", "b"):
        path = data / f"{name}.csv"
        header, *rows = path.read_text().splitlines()
        path.write_text("\n".join([header, *(r.rpartition(",")[0] + ",0.1" for r in rows), ""]))
    with pytest.raises(UserError, match=r"output 'y' is 0\.1 in every training sample"):
        make(data)
    assert not (data / "mine").exists()


def test_output_that_differs_between_records_moves(data: Path) -> None:
    for name, value in (("a", "1"), ("b", "2")):
        path = data / f"{name}.csv"
        header, *rows = path.read_text().splitlines()
        path.write_text(
            "\n".join([header, *(r.rpartition(",")[0] + f",{value}" for r in rows), ""])
        )
    assert len(load_problem(make(data)).train) == 2


def test_nothing_is_overwritten(data: Path) -> None:
    path = make(data)
    path.write_text("precious")
    with pytest.raises(UserError, match="is not empty"):
        make(data)
    assert path.read_text() == "precious"
