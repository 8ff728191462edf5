from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from asia.data import data_digest
from asia.data.intake.conversion import take_in
from asia.errors import UserError

from .clean import CLEAN, STEP, WANTED, digest, record, signals

T, U, Y = signals()
START = datetime(2026, 3, 1, 23, 59, 55)


def rows(stamp: Callable[[float], str] = str, sep: str = ",", comma: bool = False) -> list[str]:
    lines = [sep.join((stamp(t), str(u), str(y))) for t, u, y in zip(T, U, Y, strict=True)]
    return [line.replace(".", ",") for line in lines] if comma else lines


def table(head: str = "t,u,y", end: str = "\n", **given: object) -> str:
    return end.join([head, *rows(**given), ""])  # type: ignore[arg-type]


def stamped(shape: str) -> Callable[[float], str]:
    return lambda t: (START + timedelta(seconds=t)).strftime(shape)


def excel(t: float) -> str:
    return f"{46082.5 + t / 86400:.11f}"


def midnight(t: float) -> str:
    return (START + timedelta(seconds=t)).strftime("%H:%M:%S.%f")


SAME: dict[str, str | bytes] = {
    "clean": table(),
    "semicolons": table("t;u;y", sep=";"),
    "decimal comma": table("t;u;y", sep=";", comma=True),
    "tabs and comma": table("t\tu\ty", sep="\t", comma=True),
    "bars": table("t|u|y", sep="|"),
    "blanks": table("t u y", sep="   "),
    "units row": "t,u,y\ns,V,m\n" + "\n".join(rows()),
    "units in brackets": table("t [s],u [V],y (m)"),
    "units row in brackets": "t,u,y\n[s],[V],[m]\n" + "\n".join(rows()),
    "comments": "# rig 4\n% run 7\n" + table() + "# end\n",
    "comment header": table("# t,u,y"),
    "preamble": "Rig 4\nOperator;Ann\n\nChannels\n" + table("t;u;y", sep=";"),
    "footer": table() + "End of log\n",
    "comment between": table().replace("\n0.5,", "\n# note\n0.5,"),
    "blank lines": table().replace("\n0.5,", "\n\n\n0.5,"),
    "trailing separators": table("t,u,y,").replace("\n", ",\n").replace(",,\n", ",\n", 1),
    "carriage returns": table(end="\r\n"),
    "old line ends": table(end="\r"),
    "byte order mark": "\ufeff" + table(),
    "utf-16": table().encode("utf-16"),
    "latin-1": table("t [s],u [°C],y").encode("latin-1"),
    "iso": table(stamp=stamped("%Y-%m-%dT%H:%M:%S.%f")),
    "iso with a blank": table("timestamp,u,y", stamp=stamped("%Y-%m-%d %H:%M:%S.%f")),
    "iso with a zone": table(stamp=stamped("%Y-%m-%dT%H:%M:%S.%f+01:00")),
    "german": table("Zeit;u;y", sep=";", stamp=stamped("%d.%m.%Y %H:%M:%S.%f")),
    "german with comma": table(
        "Zeit;u;y", sep=";", comma=True, stamp=stamped("%Y-%m-%d %H:%M:%S.%f")
    ),
    "excel days": table("date,u,y", stamp=excel),
    "excel days under time": table("time,u,y", stamp=excel),
    "clock with halves": table("date,time,u,y", stamp=stamped("%m/%d/%Y,%I:%M:%S.%f %p")),
    "newest first": "\n".join(["t,u,y", *reversed(rows())]),
    "three rows of names": "Rig 4,,\nDate:,2026-03-01,\n,,\nt,u,y\n,Valve,Level\n[s],[V],[m]\n"
    + "\n".join(rows()),
    "units behind values": "\n".join(
        ["t,u,y", *(f"{t} s,{u} m/s,{y} °C" for t, u, y in zip(T, U, Y, strict=True))]
    ),
    "wide footer": table("t;u;y", sep=";") + "End of log;;\nRows: 9;;\n",
    "clock over midnight": table(stamp=midnight),
    "date and time": table("date,time,u,y", stamp=stamped("%d.%m.%Y,%H:%M:%S.%f")),
    "milliseconds": table("t [ms],u,y", stamp=lambda t: f"{1000 * t:.0f}"),
    "unix time": table("timestamp,u,y", stamp=lambda t: f"{1.79e9 + t:.2f}"),
    "unix nanoseconds": table("t,u,y", stamp=lambda t: str(1_790_000_000 * 10**9 + round(t * 1e9))),
    "jitter below 1 %": table(stamp=lambda t: f"{t + 0.001 * np.sin(50 * t):.6f}"),
    "quotes": table('"t","u","y"').replace("\n0.5,", '\n"0.5",'),
    "plus signs": table("t,u,y").replace(",1.", ",+1.").replace(",2.", ",2.0e0\0")
    .replace("2.0e0\0", "2."),
    "minus of a typesetter": table().replace("-", "−"),
    "columns in another order": "\n".join(
        ["note,y,t,u", *(f"x,{y},{t},{u}" for t, u, y in zip(T, U, Y, strict=True))]
    ),
    "capitals": table("T,U,Y"),
}  # fmt: skip


def write(tmp_path: Path, text: str | bytes, name: str = "log.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("name", list(SAME))
def test_ugly_files_give_the_clean_record(tmp_path: Path, name: str) -> None:
    assert digest(write(tmp_path, SAME[name])) == CLEAN


def test_units_behind_values_are_taken_over(tmp_path: Path) -> None:
    path = write(tmp_path, SAME["units behind values"])
    assert take_in([path], WANTED, "train").units == {"u": "m/s", "y": "°C"}


def test_texts_of_historians_are_missing_values(tmp_path: Path) -> None:
    lines = table().split("\n")
    for k, word in enumerate(("Bad", "I/O Timeout", "No Data", "n.a.")):
        lines[5 + k] = ",".join((*lines[5 + k].split(",")[:2], word))
    (found,) = take_in([write(tmp_path, "\n".join(lines))], WANTED, "train").records
    assert np.flatnonzero(~found.measured).tolist() == [4, 5, 6, 7]


def test_seconds_of_a_fast_clock_are_not_taken_for_days(tmp_path: Path) -> None:
    for step in (1e-3, 1 / 60, 0.0025):
        rows = [
            f"{45000 + k * step:.6f},{u},{y}" for k, (u, y) in enumerate(zip(U, Y, strict=True))
        ]
        path = write(tmp_path, "\n".join(["time,u,y", *rows]))
        (found,) = take_in([path], WANTED, "train").records
        assert found.sampling_time == pytest.approx(step, rel=1e-3)


def test_no_header(tmp_path: Path) -> None:
    path = write(tmp_path, "\n".join(rows()))
    assert digest(path, replace(WANTED, columns=("t", "u", "y"))) == CLEAN
    with pytest.raises(UserError, match="give --columns"):
        digest(path)


REFUSED = {
    "word": (table().replace("1.5", "1.5 bar", 1), "'1.5 bar.*' is not a number"),
    "infinite": (table().replace(f"{Y[3]}\n", "inf\n", 1), "is infinite"),
    "ragged": (table().replace("\n0.5,", "\n0.5,7,", 1), "cells where the rows above have 3"),
    "comma in commas": (table(comma=True), "write decimal points"),
    "no column": (table("t,u,z"), "no column 'y'"),
    "twice": (table("t,u,u").replace("t,u,u", "y,u,u"), "2 columns are named 'u'"),
    "stamps repeat": (table(stamp=lambda t: f"{t:.0f}"), "remove rows that were written twice"),
    "rows in no order": (
        "\n".join(["t,u,y", *sum(zip(rows()[30:], rows()[:30], strict=True), ())]),
        "line 3: time goes back, as in 30 of 60 rows: sort the rows by time",
    ),
    "one row": ("t,u,y\n0,1,2\n", "1 row with a time stamp, too few to find the sampling time"),
    "no output": (
        "\n".join(["t,u,y", *(f"{t},{u}," for t, u in zip(T, U, strict=True))]),
        "output 'y' has no value in any of 60 rows: name another",
    ),
    "no input": (
        "\n".join(["t,u,y", *(f"{t},,{y}" for t, y in zip(T, Y, strict=True))]),
        "input 'u' has no value in any of 60 rows: name another",
    ),
    "never in one row": (
        "\n".join(["t,u,y", *(f"{t},{u}," if k % 2 else f"{t},,{y}" for k, (t, u, y) in
        enumerate(zip(T, U, Y, strict=True)))]),
        "no row has every input and an output",
    ),
    "no stamps": ("u,y\n" + "\n".join(r.partition(",")[2] for r in rows()), "--sampling-time"),
    "empty": ("", "is empty"),
    "header alone": ("t,u,y\n", "no data below"),
    "pointer": ("version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
    "binary": (b"\x89PNG\0\0\0\1\0\2" * 9, "not a text file"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(REFUSED))
def test_unreadable_files_are_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    text, expected = REFUSED[name]
    with pytest.raises(UserError, match=expected) as caught:
        digest(write(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert "log.csv" in str(caught.value)


def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"kind '\.doc', which ASIA does not read: .*\.csv"):
        digest(write(tmp_path, "x", "log.doc"))


def test_missing_values_of_many_pieces_are_one_note(tmp_path: Path) -> None:
    lines = table().split("\n")
    for k in range(5, 60, 5):
        lines[k] = lines[k].rpartition(",")[0] + ","
        lines[k + 1] = f"{T[k]},,{Y[k]}"
    found = take_in([write(tmp_path, "\n".join(lines))], WANTED, "train", least=3)
    notes = [note.partition("log.csv: ")[2] for note in found.notes]
    assert notes == [
        "cut where inputs are missing (11 samples)",
        "11 samples without measured outputs left out",
        "cut into 12 records",
    ]


def test_a_record_begins_where_time_goes_back(tmp_path: Path) -> None:
    path = write(tmp_path, "\n".join(["t,u,y", *rows(), *rows(), *rows()]))
    found = take_in([path], WANTED, "train")
    assert [data_digest([r]) for r in found.records] == [CLEAN] * 3
    assert found.notes == (
        f"{path}: time goes back 2 times, a new record begins at each",
        f"{path}: cut into 3 records",
    )


def test_a_sampling_time_that_drifts_is_told_by_its_ends(tmp_path: Path) -> None:
    stamps = np.cumsum(np.linspace(0.1, 0.14, len(T)))
    lines = [f"{t:.6f},{u},{y}" for t, u, y in zip(stamps, U, Y, strict=True)]
    path = write(tmp_path, "\n".join(["t,u,y", *lines]))
    expected = r"the sampling time varies from 0\.101 s to 0\.14 s, and outputs of a test are never"
    with pytest.raises(UserError, match=expected):
        take_in([path], WANTED, "test")


def test_a_gap_cuts(tmp_path: Path) -> None:
    lines = table().split("\n")
    found = take_in([write(tmp_path, "\n".join(lines[:21] + lines[25:]))], WANTED, "train")
    whole = record()
    assert data_digest(found.records) == data_digest([whole[:20], whole[24:]])
    assert [r.name for r in found.records] == ["log_1", "log_2"]
    assert any("1 gap in time" in note for note in found.notes)


def test_missing_inputs_cut_and_short_segments_are_dropped(tmp_path: Path) -> None:
    lines = table().split("\n")
    lines[4], lines[31] = "0.75,,1.0", "7.5,NaN,1.0"
    path = write(tmp_path, "\n".join(lines))
    found = take_in([path], WANTED, "train", least=10)
    whole = record()
    assert data_digest(found.records) == data_digest([whole[4:30], whole[31:]])
    assert any("1 piece shorter than 10 samples" in note for note in found.notes)
    with pytest.raises(UserError, match=r"no piece of .* has 50 samples"):
        take_in([path], WANTED, "train", least=50)


def test_jitter_is_resampled_for_training_and_refused_for_a_test(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    stamps = np.array(T) + rng.uniform(-0.1, 0.1, len(T)) * STEP
    y = np.sin(0.2 * stamps)
    lines = [f"{t:.6f},{u},{v:.6f}" for t, u, v in zip(stamps, U, y, strict=True)]
    path = write(tmp_path, "\n".join(["t,u,y", *lines]))
    found = take_in([path], WANTED, "train")
    (made,) = found.records
    assert made.sampling_time == pytest.approx(STEP, rel=2e-3)
    at = stamps[0] + made.sampling_time * np.arange(len(made))
    assert np.abs(made.y[:, 0] - np.sin(0.2 * at)).max() < 1e-3
    # An input counts from its own stamp on, not before.
    last = np.searchsorted(stamps, at + 1e-6, side="right") - 1
    assert np.array_equal(made.u[:, 0], np.array(U)[last])
    assert any("resampled" in note for note in found.notes)
    with pytest.raises(UserError, match="outputs of a test are never interpolated"):
        take_in([path], WANTED, "test", STEP)


def test_one_wide_file_becomes_many_records(tmp_path: Path) -> None:
    lines = [
        f"{name},{t},{u},{y}" for name in ("slow", "fast") for t, u, y in zip(T, U, Y, strict=True)
    ]
    path = write(tmp_path, "\n".join(["run,t,u,y", *lines]))
    found = take_in([path], replace(WANTED, experiment="run"), "train")
    assert [r.name for r in found.records] == ["slow", "fast"]
    assert data_digest(found.records[:1]) == CLEAN == data_digest(found.records[1:])


def test_a_finer_record_is_brought_to_the_slower_rate(tmp_path: Path) -> None:
    fine = [f"{k * STEP / 2},{k % 5},{k}" for k in range(120)]
    paths = [write(tmp_path, table()), write(tmp_path, "\n".join(["t,u,y", *fine]), "fine.csv")]
    slow, quick = take_in(paths, WANTED, "train").records
    assert slow.sampling_time == quick.sampling_time == STEP
    assert quick.y[:3, 0].tolist() == [0.0, 2.0, 4.0]
    assert quick.u[:2, 0].tolist() == [0.5, 2.5]


@pytest.mark.parametrize("rate", [60.0, 3.0, 44_100.0, 48.0])
def test_rates_are_found_from_rounded_stamps(tmp_path: Path, rate: float) -> None:
    digits = 3 if rate < 100 else 7
    lines = [f"{k / rate:.{digits}f},{k % 7},{k % 11}" for k in range(200)]
    path = write(tmp_path, "\n".join(["t,u,y", *lines]))
    (made,) = take_in([path], WANTED, "train").records
    assert made.sampling_time == pytest.approx(1 / rate, rel=1e-4)
    assert len(made) == 200
