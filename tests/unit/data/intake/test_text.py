from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from asia.data.intake.conversion import Intake, take_in
from asia.data.intake.sheet import Wanted
from asia.errors import UserError

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


def read_file(
    path: Path, text: str | bytes, inputs: str = "u", outputs: str = "y", time: str | None = None
) -> Intake:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    wanted = Wanted(tuple(inputs.split("|")), tuple(outputs.split("|")), time)
    return take_in([path], wanted, "test", 1.0)


def read(path: Path, text: str | bytes, inputs: str = "u", outputs: str = "y") -> np.ndarray:
    (t,) = read_file(path, text, inputs, outputs).records
    return np.concatenate([t.u, t.y], axis=1)


@settings(max_examples=50, deadline=None)
@given(
    values=arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=finite),
    delimiter=st.sampled_from([",", ";", "\t"]),
    end=st.sampled_from(["\n", "\r\n"]),
    quoted=st.booleans(),
)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    values: np.ndarray,
    delimiter: str,
    end: str,
    quoted: bool,
) -> None:
    names = ["y", "motor [rad/s]", "u"]
    header = delimiter.join(f'"{n}"' if quoted else n for n in names)
    rows = [delimiter.join(repr(v) for v in row) for row in values.tolist()]
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    got = read(path, end.join([header, *rows, ""]), "u|motor [rad/s]", "y")
    assert np.array_equal(got, values[:, [2, 1, 0]])


@pytest.mark.parametrize("block", [2**20, 1, 7])
@pytest.mark.parametrize(
    "text",
    [
        "u;y\n1,5;2\n3;4,25\n",
        "u\ty\n1,5\t2\n3\t4,25\n",
        "\ufeffu,y\n1.5,2\n3,4.25\n",
        "# u, y\n1.5, 2\n3, 4.25\n",
        "\nu,y\n\n1.5,2\n\n3,4.25\n\n",
        "u,y,\n1.5,2,\n3,4.25,\n,,\n",
        "note,u,y\nfirst,1.5,2\nsecond,3,4.25\n",
    ],
)
def test_layouts(tmp_path: Path, text: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asia.data.intake.text._BLOCK", block)
    got = read(tmp_path / "a.csv", text)
    assert got.tolist() == [[1.5, 2.0], [3.0, 4.25]]


def test_utf16(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "u,y\n1,2\n".encode("utf-16")).tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("u,z\n1,2\n", "no column 'y' (it has u, z)"),
        ("u,y,y\n1,2,3\n", "2 columns are named 'y'"),
        ("u,y\n1,2\n3,inf\n4,5\n", "column 'y', line 3: the value is infinite"),
        ("u,y\n1,2\n3,abc\n", "column 'y', line 3: 'abc' is not a number"),
        ("u,y\n1,2\n3\n", "line 3: 1 cells where the rows above have 2"),
        ("t,u,y\n0,1,5,2\n1,2,5,3\n", "the header has 3 cells, the rows below it 4 cells"),
        ("", "is empty"),
        ("u,y\n", "no data below it"),
        (b"\x89PNG\0\x01", "is not a text file"),
    ],
)
def test_bad_files(tmp_path: Path, text: str | bytes, expected: str) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path / "a.csv", text)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("u,y\n1,2\nnan,3\n4,5\n6,7\n", [[[1, 2]], [[4, 5], [6, 7]]]),
        ("u,y\n1,2\n,3\n4,5\n", [[[1, 2]], [[4, 5]]]),
        ("u,y\n1,2\n3,4\n5,\n6,\n", [[[1, 2], [3, 4]]]),
        ("u,y\nV,m\n1,2\n3,4\n", [[[1, 2], [3, 4]]]),
    ],
)
def test_missing_values_cut_and_trim(tmp_path: Path, text: str, expected: list[Any]) -> None:
    records = read_file(tmp_path / "a.csv", text).records
    assert [np.hstack([r.u, r.y]).tolist() for r in records] == expected


@pytest.mark.parametrize("text", ["1,2\n3,4\n", "0,5;1,2\n1,5;2,2\n", "1e-3\t-2\n3\t4\n"])
def test_missing_header(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path / "a.csv", text)
    assert str(caught.value).endswith(
        "the first row holds numbers: add a header row with the column names, or give --columns"
    )


def test_numbers_may_be_names(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "1,2\n3,4\n", "1", "2").tolist() == [[3.0, 4.0]]


def test_known_columns_are_listed_once(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path / "a.csv", "force,speed\n1,2\n")
    assert str(caught.value).endswith("has no column 'u' (it has force, speed)")


def test_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        take_in([tmp_path / "a.csv"], Wanted(("u",), ("y",)), "train", 1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t,u,y\n0,1,2\n0.5,1,2\n1,1,2\n1.5,1,2\n", "one output in 2 is kept"),
        ("t,u,y\n0,1,2\n1,1,2\n2,1,2\n5,1,2\n6,1,2\n", "1 gap in time"),
        ("t,u,y\n0,1,2\n1,1,2\n2,1,2\n", None),
        ("index,u,y\n0,1,2\n1,1,2\n2,1,2\n", None),
    ],
)
def test_timestamps_decide(tmp_path: Path, text: str, expected: str | None) -> None:
    notes = read_file(tmp_path / "a.csv", text).notes
    assert bool(notes) == (expected is not None)
    assert expected is None or expected in notes[0]
    assert read_file(tmp_path / "a.csv", text, time="none").notes == ()


def test_stamps_that_contradict_the_sampling_time_are_refused(tmp_path: Path) -> None:
    text = "t,u,y\n" + "".join(f"{10 * k},{k},{k}\n" for k in range(9))
    with pytest.raises(UserError, match="every 10 s, but the sampling time is 1 s: give that samp"):
        read_file(tmp_path / "a.csv", text)
    with pytest.raises(UserError, match="the time stamp repeats"):
        read_file(tmp_path / "a.csv", "time,u,y\n0,1,2\n1,1,2\n1,1,2\n")


def test_time_may_be_an_input(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "t,y\n0,1\n0,2\n", "t").tolist() == [[0.0, 1.0], [0.0, 2.0]]


def test_a_long_table_of_numbers_is_read_like_one_of_texts(tmp_path: Path) -> None:
    rows = [f"{k / 8};{k % 7},5;{k % 5},25" for k in range(3000)]
    fast = read_file(tmp_path / "a.csv", "\n".join(["t;u;y", *rows]))
    slow = read_file(tmp_path / "b.csv", "\n".join(["t;u;y;note", *(f"{r};x" for r in rows)]))
    assert np.array_equal(fast.records[0].y, slow.records[0].y)
    assert np.array_equal(fast.records[0].u, slow.records[0].u)
