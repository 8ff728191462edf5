"""One reading of time: every way of writing it gives the same seconds, or a question."""

import runpy
from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.data.intake.conversion import Intake, take_in
from asia.data.intake.sheet import Column, FileTable, Wanted, as_objects
from asia.data.intake.timestamps import _WORDS, read_times
from asia.errors import UserError

SCRIPT = Path(__file__).parents[4] / "benchmarks" / "data" / "logger_files.py"
WANTED = Wanted(("u",), ("y",))


def table(**columns: Sequence[object]) -> FileTable:
    cells = {name: Column(as_objects(values)) for name, values in columns.items()}
    return FileTable("log", cells, where="log.csv")


def seconds(name: str, sheet: FileTable, unit: str | None = None) -> list[float]:
    return read_times(sheet, name, Wanted((), (), time_unit=unit)).seconds.tolist()


def read(path: Path, text: str, **options: Any) -> Intake:
    path.write_text(text, encoding="utf-8")
    return take_in([path], Wanted(("u",), ("y",), **options), "train")


def rows(stamps: Sequence[str], head: str = "Time") -> str:
    lines = [f"{t},{k % 7},{k % 5}" for k, t in enumerate(stamps)]
    return "\n".join([f"{head},u,y", *lines, ""])


@pytest.mark.slow
def test_no_logger_file_is_silently_wrong(tmp_path: Path) -> None:
    script = runpy.run_path(str(SCRIPT))
    found = script["run"](2 * len(script["KINDS"]), 11, tmp_path)
    bad = [one for one in found if one[2] == "wrong" or (one[2] == "asked") != one[1]]
    assert bad == []


@pytest.mark.parametrize("kind", ["british", "unit_row", "compact", "two_numbers", "set_back"])
def test_a_logger_file_is_read_as_it_was_meant(tmp_path: Path, kind: str) -> None:
    script = runpy.run_path(str(SCRIPT))
    made = script[kind](np.random.default_rng(3))
    path = tmp_path / f"log{made.suffix}"
    script["write"](made, path)
    assert script["outcome"](made, path) == ("right", "")


@settings(max_examples=60, deadline=None)
@given(
    word=st.sampled_from(sorted(_WORDS)),
    upper=st.booleans(),
    step=st.sampled_from([0.25, 1.0, 3.0, 10.0]),
    style=st.sampled_from(["{} ({})", "{} [{}]", "{}_{}", "{} in {}", "{} / {}"]),
)
def test_a_unit_gives_the_same_seconds_wherever_it_stands(
    word: str, upper: bool, step: float, style: str
) -> None:
    factor = _WORDS[word].factor
    shown = word.upper() if upper and word.upper().casefold() == word else word
    values = [step * k for k in range(20)]
    expected = np.round(np.array(values) * factor, 9).tolist()
    head = style.format("Time", shown)
    assert seconds(head, table(**{head: values})) == pytest.approx(expected)
    sheet = FileTable("log", {"Time": Column(np.array(values), shown)}, where="log.csv")
    assert seconds("Time", sheet) == pytest.approx(expected)
    assert seconds("Time", table(Time=values), word) == pytest.approx(expected)


@settings(max_examples=40, deadline=None)
@given(
    start=st.datetimes(datetime(2000, 1, 1), datetime(2049, 1, 1)),
    step=st.sampled_from([1.0, 10.0, 60.0, 900.0]),
    day=st.sampled_from(["%d.%m.%Y", "%Y-%m-%d", "%Y/%m/%d", "%d %b %Y"]),
    clock=st.sampled_from([("%H:%M:%S", ""), ("%I:%M:%S", "%p")]),
)
def test_the_order_of_evidence_columns_plays_no_part(
    start: datetime, step: float, day: str, clock: tuple[str, str]
) -> None:
    start = start.replace(microsecond=0)
    moments = [start + timedelta(seconds=step * k) for k in range(40)]
    columns = {"Date": [m.strftime(day) for m in moments]}
    columns["Time"] = [m.strftime(clock[0]) for m in moments]
    if clock[1]:
        columns["Half"] = [m.strftime(clock[1]) for m in moments]
    expected = [step * k for k in range(40)]
    for order in permutations(columns):
        sheet = table(**{name: columns[name] for name in order})
        assert seconds("Time", sheet) == expected
        assert seconds("Date", sheet) == expected or len(set(columns["Date"])) == 40


MEANT = {
    "08:00 beside a date": (
        {"Date": ["05.03.2021"] * 3, "Time": ["08:00", "08:01", "08:02"]}, 60.0,
    ),
    "day first by a midnight": (
        {"Time": ["05/03/2021 23:58", "05/03/2021 23:59", "06/03/2021 00:00"]}, 60.0,
    ),
    "month first by a midnight": (
        {"Time": [
            "03/05/2021 11:59:58 PM", "03/05/2021 11:59:59 PM", "03/06/2021 12:00:00 AM",
        ]}, 1.0,
    ),
    "month first by a day above 12": ({"Time": ["01/31/2021", "02/01/2021"]}, 86400.0),
    "digits": ({"Time": [20230518090000, 20230518090100]}, 60.0),
    "twelve hours without halves": ({"Time": ["12:59:58", "12:59:59", "1:00:00"]}, 1.0),
    "minutes by a wrap": ({"Time": ["59:58", "59:59", "00:00"]}, 1.0),
    "another clock of the file": (
        {"Time": ["08:00", "08:01", "08:02"], "Elapsed": ["00:00:00", "00:01:00", "00:02:00"]},
        60.0,
    ),
    "nanoseconds beyond a double": (
        {"Time": ["1790000000000000001", "1790000000000000101", "1790000000000000201"]}, 1e-7,
    ),
    "zones": ({"Time": ["2021-10-31 02:59:00 CEST", "2021-10-31 02:00:00 CET"]}, 60.0),
    "end of a day": ({"Time": ["31.12.2021 23:00", "31.12.2021 24:00"]}, 3600.0),
}  # fmt: skip


@pytest.mark.parametrize("name", list(MEANT))
def test_evidence_decides(name: str) -> None:
    columns, step = MEANT[name]
    found = seconds("Time", table(**columns))
    assert np.diff(found) == pytest.approx([step] * (len(found) - 1))


ASKED = {
    "day or month": (["01/02/2021", "02/02/2021", "03/02/2021"], "month-first", "day-first"),
    "hours or minutes": (["08:00", "08:01", "08:02"], "h:m", "m:s"),
    "seconds or days": (["45000", "45000.5", "45001"], "seconds", "days"),
}


@pytest.mark.parametrize("name", list(ASKED))
def test_two_readings_are_a_question_that_an_option_answers(tmp_path: Path, name: str) -> None:
    stamps, first, second = ASKED[name]
    with pytest.raises(UserError, match="can be read as") as caught:
        read(tmp_path / "log.csv", rows(stamps))
    for option in (first, second):
        assert f"--time-unit {option}" in str(caught.value)
    found = [
        read(tmp_path / "log.csv", rows(stamps), time_unit=option).records[0].sampling_time
        for option in (first, second)
    ]
    assert found[0] != pytest.approx(found[1])


@pytest.mark.parametrize("head", ["Time (mintues)", "Time [ticks]"])
def test_an_unknown_unit_is_refused(tmp_path: Path, head: str) -> None:
    with pytest.raises(UserError, match=r"no unit of time: .*--time-unit") as caught:
        read(tmp_path / "log.csv", rows(["0", "1", "2"], head))
    assert ("did you mean 'minutes'" in str(caught.value)) == ("mintues" in head)


def test_an_unknown_word_of_the_option_is_refused(tmp_path: Path) -> None:
    for stamps in (["0", "1", "2"], ["10:00:00", "10:00:01", "10:00:02"]):
        with pytest.raises(UserError, match=r"--time-unit is 'minuts'.* did you mean 'minutes'"):
            read(tmp_path / "log.csv", rows(stamps), time_unit="minuts")


def test_two_units_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="two units, minutes and seconds"):
        read(tmp_path / "log.csv", rows(["0", "1", "2"], "time_min [s]"))


def test_the_conclusion_has_its_evidence(tmp_path: Path) -> None:
    (text,) = read(tmp_path / "log.csv", rows(["0", "0.5", "1.0"], "Time (minutes)")).readings
    assert text.endswith("log.csv: sampled every 30 s: column Time (minutes), 2 equal steps")


def test_columns_of_one_name_are_refused_with_their_groups(tmp_path: Path) -> None:
    lines = [",Zone 1,,Zone 2,", "Time,u,y,u,y", *(f"{k},{k % 7},{k % 5},1,2" for k in range(9))]
    with pytest.raises(UserError, match=r"2 columns are named 'u', name one of 'Zone 1 u', 'Zone "):
        read(tmp_path / "log.csv", "\n".join(lines))
    found = take_in([tmp_path / "log.csv"], Wanted(("Zone 1 u",), ("Zone 2 y",)), "train")
    assert found.records[0].u[:3, 0].tolist() == [0, 1, 2]
    assert found.records[0].y[:3, 0].tolist() == [2, 2, 2]
    with pytest.raises(UserError, match="2 columns are named 'Time', rename all but one"):
        read(tmp_path / "log.csv", "Time,Time,u,y\n0,0,1,2\n1,1,2,3\n2,2,3,4\n")
