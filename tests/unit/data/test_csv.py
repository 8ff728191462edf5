from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from asia.data.sources.csv import read_csv, split_csv
from asia.errors import UserError

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


def read(path: Path, text: str | bytes, inputs: str = "u", outputs: str = "y") -> np.ndarray:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    t = read_csv(path, inputs.split("|"), outputs.split("|"), 1.0).trajectory
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
    monkeypatch.setattr("asia.data.sources.csv._BLOCK", block)
    got = read(tmp_path / "a.csv", text)
    assert got.tolist() == [[1.5, 2.0], [3.0, 4.25]]


def test_utf16(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "u,y\n1,2\n".encode("utf-16")).tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("u,z\n1,2\n", "no column 'y' (it has u, z)"),
        ("u,y,y\n1,2,3\n", "2 columns are named 'y'"),
        ("u,y\n1,2\nnan,3\n4,5\n", "line 3, column 'u': the value is missing or infinite ('nan')"),
        ("u,y\n1,2\n\n3,inf\n4,5\n", "line 4, column 'y'"),
        ("u,y\n1,2\n,3\n4,5\n", "line 3, column 'u': the cell is empty"),
        ("u,y\n1,2\n3,abc\n", "line 3, column 'y': 'abc' is not a number"),
        ("u,y\nV,V\n1,2\n", "line 2, column 'u': 'V' is not a number"),
        (
            "u,y\n1,2\n3,\n4,\n",
            "unequal lengths, column 'y' ends before line 3 but the file goes on to line 4",
        ),
        ("u,y\n1,2\n3\n", "line 3: 1 cells where the header has 2"),
        ("t,u,y\n0,1,5,2\n1,2,5,3\n", "line 2: 4 cells where the header has 3"),
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


@pytest.mark.parametrize("text", ["1,2\n3,4\n", "0,5;1,2\n1,5;2,2\n", "1e-3\t-2\n3\t4\n"])
def test_missing_header(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path / "a.csv", text)
    assert str(caught.value).endswith(
        "the first row holds numbers: add a header row with the column names"
    )


def test_numbers_may_be_names(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "1,2\n3,4\n", "1", "2").tolist() == [[3.0, 4.0]]


def test_known_columns_are_listed_once(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path / "a.csv", "force,speed\n1,2\n")
    assert str(caught.value).endswith("has no column 'u' (it has force, speed)")


def test_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        read_csv(tmp_path / "a.csv", ["u"], ["y"], 1.0)
    with pytest.raises(UserError, match="cannot read"):
        read_csv(tmp_path, ["u"], ["y"], 1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("t,u,y\n0,1,2\n0.5,1,2\n1,1,2\n", "steps by 0.5, but sampling_time is 1 s"),
        ("time,u,y\n0,1,2\n1,1,2\n1,1,2\n", "does not increase at line 4"),
        ("t,u,y\n0,1,2\n1,1,2\n2,1,2\n5,1,2\n", "gap of 3 s at line 5"),
        ("t,u,y\n10:00,1,2\n10:01,1,2\n", "does not read as numbers"),
        ("t,u,y\n0,1,2\n1,1,2\n2,1,2\n", None),
    ],
)
def test_time_column_is_compared(tmp_path: Path, text: str, expected: str | None) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    warnings = read_csv(path, ["u"], ["y"], 1.0).warnings
    assert len(warnings) == (expected is not None)
    assert expected is None or expected in warnings[0]


def test_time_may_be_an_input(tmp_path: Path) -> None:
    assert read(tmp_path / "a.csv", "t,y\n0,1\n0,2\n", "t").tolist() == [[0.0, 1.0], [0.0, 2.0]]


def test_split_keeps_every_row_and_column(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n" + "".join(f"{k},{k},{k}\n" for k in range(10)))
    first, last = split_csv(path, ["u", "y"], 0.2)
    assert first.splitlines()[-1] == "7,7,7"
    assert last.splitlines() == ["t,u,y", "8,8,8", "9,9,9"]
