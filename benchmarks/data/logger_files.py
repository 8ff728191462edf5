"""Read 200 files as data loggers write them, and compare sampling time, records and values with the
truth.

    python benchmarks/data/logger_files.py [--files 200] [--seed 0] [--show]

A file is right, asked about (one error that says what to do), or silently wrong. Some files are
ambiguous by design, such as 01/02/2021 to 08/02/2021, one row a day: those must be asked about.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Wanted
from asia.errors import UserError

Rng = np.random.Generator
NAMES = (("u", "y"), ("Valve", "Level"), ("Heizung", "Temperatur"), ("Débit", "Niveau"))
STEPS = (0.01, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 900.0, 3600.0)


@dataclass
class Log:
    """What was measured, before a logger writes it down."""

    step: float
    start: datetime
    u: np.ndarray
    y: np.ndarray
    names: tuple[str, str] = ("u", "y")
    at: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Seconds from the start to each row."""
    cuts: tuple[int, ...] = ()
    """Rows at which a new record begins."""

    def stamps(self, shape: str, digits: int = 0) -> list[str]:
        """The stamps by `strftime`; %f gets so many digits."""
        found: list[str] = []
        for seconds in self.at:
            moment = self.start + timedelta(microseconds=round(1e6 * float(seconds)))
            part = f"{moment.microsecond:06d}"[:digits]
            found.append(moment.strftime(shape.replace("%f", part)))
        return found

    def records(self) -> list[tuple[np.ndarray, np.ndarray]]:
        edges = [0, *self.cuts, len(self.u)]
        return [(self.u[a:b], self.y[a:b]) for a, b in pairwise(edges)]


@dataclass
class Written:
    """A file and the truth about it."""

    suffix: str
    content: bytes | list[tuple[str, list[list[Any]]]]
    """Bytes, or the rows of the worksheets of a workbook."""
    log: Log
    asked: bool = False
    """Whether no reader could know what it says."""


def new_log(rng: Rng, steps: Sequence[float] = STEPS, rows: int | None = None) -> Log:
    count = rows or int(rng.integers(80, 400))
    step = float(rng.choice(np.array(steps)))
    day = datetime(2018, 1, 1) + timedelta(days=int(rng.integers(0, 2900)))
    start = day + timedelta(seconds=int(rng.integers(0, 86400)))
    u = np.round(rng.normal(size=count), 3)
    y = np.round(20.0 + np.cumsum(rng.normal(size=count)), 2)
    names = NAMES[int(rng.integers(len(NAMES)))]
    return Log(step, start, u, y, names, step * np.arange(count))


def text(
    log: Log,
    head: Sequence[str],
    columns: Sequence[Sequence[str]],
    sep: str = ",",
    *,
    comma: bool = False,
    above: Sequence[str] = (),
    below: Sequence[str] = (),
    end: str = "\n",
    encoding: str = "utf-8",
) -> bytes:
    """A table of text: the columns of time, then u and y. comma: decimal commas."""
    numbers = [[f"{v:.3f}" for v in log.u], ["" if np.isnan(v) else f"{v:.2f}" for v in log.y]]
    if comma:
        numbers = [[cell.replace(".", ",") for cell in column] for column in numbers]
    rows = [sep.join(cells) for cells in zip(*columns, *numbers, strict=True)]
    lines = [*above, sep.join([*head, *log.names]), *rows, *below, ""]
    return end.join(lines).encode(encoding)


def digits(log: Log) -> int:
    """Digits of the seconds that the sampling time needs."""
    return 0 if log.step >= 1 else 2 if round(log.step * 100) == log.step * 100 else 3


def iso(rng: Rng) -> Written:
    log = new_log(rng)
    zone = str(rng.choice(["", "Z", "+01:00", "+0530"]))
    shape = str(rng.choice(["%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M:%S", "%Y/%m/%d %H:%M:%S"]))
    shape += ".%f" if digits(log) else ""
    name = str(rng.choice(["timestamp", "Time", "datetime", "TIME_STAMP", "DateTime"]))
    return Written(".csv", text(log, [name], [[s + zone for s in log.stamps(shape, 3)]]), log)


def german(rng: Rng) -> Written:
    log = new_log(rng)
    shape = "%d.%m.%Y %H:%M:%S" + (",%f" if digits(log) else "")
    name = str(rng.choice(["Zeit", "Zeitstempel", "Datum/Uhrzeit", "Messzeit"]))
    above = ["Anlage 4", "Prüfer;Müller", ""] if rng.random() < 0.5 else []
    encoding = str(rng.choice(["latin-1", "utf-8-sig", "utf-16"]))
    content = text(log, [name], [log.stamps(shape, 3)], ";", comma=True, above=above, end="\r\n",
                   encoding=encoding)  # fmt: skip
    return Written(".csv", content, log)


def german_two_columns(rng: Rng) -> Written:
    log = new_log(rng)
    clock = "%H:%M:%S" + (",%f" if digits(log) else "")
    columns = [log.stamps("%d.%m.%Y"), log.stamps(clock, 3)]
    head = ["Datum", "Uhrzeit"]
    if rng.random() < 0.5:
        head, columns = head[::-1], columns[::-1]
    return Written(".csv", text(log, head, columns, ";", comma=True, encoding="latin-1"), log)


def no_seconds(rng: Rng) -> Written:
    log = new_log(rng, (60.0, 300.0, 600.0, 900.0, 3600.0))
    log.start = log.start.replace(second=0)
    shape = str(rng.choice(["%d.%m.%Y %H:%M", "%Y-%m-%d %H:%M", "%d.%m.%y %H:%M"]))
    return Written(".txt", text(log, ["Datum"], [log.stamps(shape)], "\t"), log)


def american(rng: Rng) -> Written:
    log = new_log(rng)
    half = rng.random() < 0.7
    shape = "%m/%d/%Y " + ("%I:%M:%S" if half else "%H:%M:%S")
    shape += (".%f" if digits(log) else "") + (" %p" if half else "")
    # One midnight inside tells month and day apart.
    span = float(log.at[-1])
    log.start = log.start.replace(hour=0, minute=0, second=0) - timedelta(seconds=int(span / 2))
    return Written(".csv", text(log, ["Date"], [log.stamps(shape, 3)]), log)


def british(rng: Rng) -> Written:
    log = new_log(rng)
    span = float(log.at[-1])
    log.start = log.start.replace(hour=0, minute=0, second=0) - timedelta(seconds=int(span / 2))
    shape = "%d/%m/%Y %H:%M:%S" + (".%f" if digits(log) else "")
    return Written(".csv", text(log, ["Time"], [log.stamps(shape, 3)]), log)


def one_day(rng: Rng) -> Written:
    """Day and month in whatever order: it makes no difference within a day."""
    log = new_log(rng, (1.0, 5.0, 10.0))
    log.start = log.start.replace(day=int(rng.integers(1, 12)), hour=9)
    shape = str(rng.choice(["%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S", "%d-%m-%Y %H:%M:%S"]))
    return Written(".csv", text(log, ["Timestamp"], [log.stamps(shape)]), log)


def days_or_months(rng: Rng) -> Written:
    log = new_log(rng, (86400.0,), 12)
    log.start = datetime(2021, int(rng.integers(1, 12)), 1)
    shape = str(rng.choice(["%d/%m/%Y", "%d-%m-%Y"]))
    return Written(".csv", text(log, ["Date"], [log.stamps(shape)]), log, asked=True)


UNITS = {
    1e-6: ["us", "µs", "μs", "usec", "microseconds"],
    1e-3: ["ms", "msec", "milliseconds", "Millisekunden"],
    1.0: ["s", "sec", "seconds", "Sek", "Sekunden", "SEC"],
    60.0: ["min", "minutes", "Minuten", "MIN"],
    3600.0: ["h", "hours", "hr", "Std", "Stunden"],
    86400.0: ["d", "days", "Tage"],
}


def unit_of(rng: Rng, log: Log) -> tuple[str, list[str]]:
    near = [f for f in UNITS if 1e-3 <= log.step / f <= 1e6]
    factor = float(rng.choice(np.array(near)))
    return str(rng.choice(UNITS[factor])), [f"{t / factor:.9g}" for t in log.at]


def unit_in_header(rng: Rng) -> Written:
    log = new_log(rng)
    unit, column = unit_of(rng, log)
    name = str(rng.choice(["Time", "t", "Zeit", "Elapsed time", "time"]))
    head = str(rng.choice([f"{name} ({unit})", f"{name} [{unit}]", f"{name}_{unit}",
                           f"{name} in {unit}", f"{name} / {unit}"]))  # fmt: skip
    return Written(".csv", text(log, [head], [column]), log)


def unit_row(rng: Rng) -> Written:
    log = new_log(rng)
    unit, column = unit_of(rng, log)
    brackets = rng.random() < 0.3
    cells = [f"[{c}]" if brackets else c for c in (unit, "V", "°C")]
    sep = str(rng.choice([",", ";", "\t"]))
    lines = text(log, ["Time"], [column], sep).decode().split("\n")
    return Written(".csv", "\n".join([lines[0], sep.join(cells), *lines[1:]]).encode(), log)


def unit_behind(rng: Rng) -> Written:
    log = new_log(rng)
    unit, column = unit_of(rng, log)
    return Written(".csv", text(log, ["time"], [[f"{c} {unit}" for c in column]]), log)


def bare_seconds(rng: Rng) -> Written:
    log = new_log(rng)
    start = float(rng.choice(np.array([0.0, 0.0, 12.5, 100.0])))
    column = [f"{start + t:.6g}" if log.step < 1 else f"{start + t:g}" for t in log.at]
    column = [f"{start + t:.4f}" for t in log.at]
    return Written(".tsv", text(log, ["t"], [column], "\t"), log)


def epoch(rng: Rng) -> Written:
    log = new_log(rng)
    power = int(rng.choice(np.array([0, 3, 6, 9]))) if log.step >= 1 else int(rng.choice([3, 6, 9]))
    first = int(log.start.timestamp())
    column = [str(first * 10**power + round(t * 10**power)) for t in log.at.tolist()]
    name = str(rng.choice(["timestamp", "time", "Epoch", "unix_time", "ts", "UTC time"]))
    name = name if name in ("timestamp", "time", "UTC time") else "time"
    return Written(".csv", text(log, [name], [column]), log)


def compact(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0, 600.0))
    if log.step >= 60 and rng.random() < 0.5:
        log.start = log.start.replace(second=0)
        shape = "%Y%m%d%H%M"
    else:
        shape = str(rng.choice(["%Y%m%d%H%M%S", "%Y%m%dT%H%M%S", "%Y%m%d %H:%M:%S"]))
    name = str(rng.choice(["Date", "time", "Zeitstempel", "TIMESTAMP"]))
    return Written(".csv", text(log, [name], [log.stamps(shape)]), log)


def compact_milliseconds(rng: Rng) -> Written:
    log = new_log(rng, (0.01, 0.1, 0.25))
    return Written(".csv", text(log, ["Timestamp"], [log.stamps("%Y%m%d%H%M%S%f", 3)]), log)


def compact_days(rng: Rng) -> Written:
    log = new_log(rng, (86400.0,))
    return Written(".csv", text(log, ["Date"], [log.stamps("%Y%m%d")]), log)


def two_numbers(rng: Rng) -> Written:
    """Date and time as numbers, as the files of exchanges and of weather services."""
    log = new_log(rng, (1.0, 10.0, 60.0))
    columns = [log.stamps("%Y%m%d"), log.stamps("%H%M%S")]
    if rng.random() < 0.5:
        columns[1] = [str(int(c)) for c in columns[1]]
    return Written(".csv", text(log, ["Date", "Time"], columns, ";"), log)


def campbell(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0, 600.0))
    stamps = [f'"{s}"' for s in log.stamps("%Y-%m-%d %H:%M:%S")]
    numbers = [str(k) for k in range(len(stamps))]
    lines = text(log, ['"TIMESTAMP"', '"RECORD"'], [stamps, numbers]).decode().split("\n")
    meta = '"TOA5","CR1000","CR1000","1234","CR1000.Std.32","CPU:rig.CR1","99","Table1"'
    units, kinds = '"TS","RN","V","degC"', '"","","Avg","Smp"'
    return Written(".dat", "\n".join([meta, lines[0], units, kinds, *lines[1:]]).encode(), log)


def labview(rng: Rng) -> Written:
    log = new_log(rng, (0.001, 0.01, 0.1))
    above = [
        "LabVIEW Measurement",
        "Writer_Version\t2",
        "Separator\tTab",
        "***End_of_Header***",
        "",
    ]
    column = [f"{t:.6f}" for t in log.at]
    return Written(".txt", text(log, ["X_Value"], [column], "\t", above=above), log)


def japanese(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 2.0, 10.0))
    if rng.random() < 0.5:
        return Written(".csv", text(log, ["Time"], [log.stamps("%y/%m/%d %H:%M:%S")]), log)
    columns = [log.stamps("%Y/%m/%d"), log.stamps("%H:%M:%S")]
    return Written(".csv", text(log, ["Date", "Time"], columns), log)


def hobo(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0, 900.0))
    span = float(log.at[-1])
    log.start = log.start.replace(hour=0, minute=0, second=0) - timedelta(seconds=int(span / 2))
    stamps = log.stamps("%m/%d/%y %I:%M:%S %p")
    numbers = [str(k + 1) for k in range(len(stamps))]
    return Written(".csv", text(log, ['"#"', '"Date Time, GMT+01:00"'], [numbers, stamps],
                                above=['"Plot Title: 20123456"']), log)  # fmt: skip


def clock(rng: Rng) -> Written:
    log = new_log(rng)
    shape = "%H:%M:%S" + (".%f" if digits(log) else "")
    name = str(rng.choice(["Time", "Uhrzeit", "clock", "Zeit"]))
    return Written(".csv", text(log, [name], [log.stamps(shape, 3)]), log)


def twelve_hours(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0, 300.0))
    shape = str(rng.choice(["%I:%M:%S %p", "%I:%M:%S%p"]))
    if rng.random() < 0.5:
        columns = [log.stamps("%Y-%m-%d"), log.stamps("%I:%M:%S"), log.stamps("%p")]
        return Written(".csv", text(log, ["Date", "Time", "AM/PM"], columns), log)
    columns = [log.stamps("%Y-%m-%d"), log.stamps(shape)]
    return Written(".csv", text(log, ["Date", "Time"], columns), log)


def minutes_beside_date(rng: Rng) -> Written:
    log = new_log(rng, (60.0, 300.0, 900.0))
    log.start = log.start.replace(second=0)
    columns = [log.stamps("%H:%M"), log.stamps("%d.%m.%Y")]
    return Written(".csv", text(log, ["Time", "Date"], columns, ";"), log)


def minutes_alone(rng: Rng) -> Written:
    log = new_log(rng, (60.0,), 50)
    log.start = log.start.replace(hour=8, minute=0, second=0)
    return Written(".csv", text(log, ["Time"], [log.stamps("%H:%M")]), log, asked=True)


def minutes_in_header(rng: Rng) -> Written:
    log = new_log(rng, (60.0, 300.0))
    log.start = log.start.replace(second=0)
    head = str(rng.choice(["Time (hh:mm)", "Uhrzeit", "Time [HH:MM]"]))
    return Written(".csv", text(log, [head], [log.stamps("%H:%M")]), log)


def minutes_and_seconds(rng: Rng) -> Written:
    """Excel writes 10:05.3 into a CSV file where a cell has hours, minutes and tenths."""
    log = new_log(rng, (0.1, 0.5))
    return Written(".csv", text(log, ["Time"], [log.stamps("%M:%S.%f", 1)]), log)


def set_back(rng: Rng) -> Written:
    """The end of summer time: a clock set back by an hour."""
    log = new_log(rng, (1.0, 10.0, 60.0))
    cut = len(log.u) // 2
    log.at = np.concatenate([log.at[:cut], log.at[cut:] - 3600.0])
    log.cuts = (cut,)
    log.start = log.start.replace(hour=2)
    return Written(".csv", text(log, ["Zeit"], [log.stamps("%d.%m.%Y %H:%M:%S")], ";"), log)


def gaps(rng: Rng) -> Written:
    log = new_log(rng)
    cut = len(log.u) // 2
    log.at = np.concatenate([log.at[:cut], log.at[cut:] + 7 * log.step])
    log.cuts = (cut,)
    shape = "%Y-%m-%d %H:%M:%S.%f"
    return Written(".csv", text(log, ["time"], [log.stamps(shape, 6)]), log)


def newest_first(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 60.0))
    lines = text(log, ["Time"], [log.stamps("%Y-%m-%d %H:%M:%S")]).decode().strip().split("\n")
    return Written(".csv", "\n".join([lines[0], *lines[:0:-1], ""]).encode(), log)


def historian(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0))
    lost = rng.choice(len(log.y) - 20, 3, replace=False) + 10
    log.y[lost] = np.nan
    shape = str(rng.choice(["%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S", "%d %b %Y %H:%M:%S"]))
    content = text(log, ["Timestamp"], [log.stamps(shape)]).decode()
    word = str(rng.choice(["Bad", "No Data", "NaN", ""]))
    lines = [line + word if line.endswith(",") else line for line in content.split("\n")]
    return Written(".csv", "\n".join(lines).encode(), log)


def words(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0))
    shape = str(rng.choice(["%b %d %Y %H:%M:%S", "%a %b %d %H:%M:%S %Y", "%d %B %Y %H:%M:%S"]))
    return Written(".txt", text(log, ["Date"], [log.stamps(shape)], ";"), log)


def american_months(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0))
    stamps = [f'"{s}"' for s in log.stamps("%b %d, %Y %I:%M:%S %p")]
    return Written(".csv", text(log, ["Time"], [stamps]), log)


def microcontroller(rng: Rng) -> Written:
    log = new_log(rng, (0.01, 0.02, 0.05, 0.1))
    head, factor = (("millis", 1e3), ("time_ms", 1e3), ("micros", 1e6), ("timeMs", 1e3))[
        int(rng.integers(4))
    ]
    first = int(rng.integers(100, 5000))
    return Written(".csv", text(log, [head], [[f"{first + t * factor:.0f}" for t in log.at]]), log)


def durations(rng: Rng) -> Written:
    log = new_log(rng, (0.5, 1.0, 10.0, 3600.0))
    pairs = [(int(t) // 86400, t % 86400) for t in log.at.tolist()]
    clocks = [f"{int(s) // 3600:02d}:{int(s) % 3600 // 60:02d}:{s % 60:09.6f}" for _, s in pairs]
    if rng.random() < 0.5:
        column = [f"{d} days {c}" for (d, _), c in zip(pairs, clocks, strict=True)]
        return Written(".csv", text(log, ["elapsed"], [column]), log)
    column = [f"{int(t) // 3600}:{int(t) % 3600 // 60:02d}:{t % 60:04.1f}" for t in log.at.tolist()]
    return Written(".csv", text(log, ["Elapsed Time"], [column]), log)


def iberian(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0))
    span = float(log.at[-1])
    log.start = log.start.replace(hour=0, minute=0, second=0) - timedelta(seconds=int(span / 2))
    columns = [log.stamps("%d/%m/%Y"), log.stamps("%H:%M:%S")]
    head = ["Fecha", "Hora"]
    return Written(".csv", text(log, head, columns, ";", comma=True), log)


def finnish(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0))
    stamps = [
        f"{m.day}.{m.month}.{m.year} {m.hour}.{m.minute:02d}.{m.second:02d}"
        for m in (log.start + timedelta(seconds=float(t)) for t in log.at)
    ]
    return Written(".csv", text(log, ["Aika"], [stamps], ";", comma=True), log)


def sheet(log: Log, head: Sequence[str], columns: Sequence[Sequence[Any]]) -> list[list[Any]]:
    numbers = [log.u.tolist(), [None if np.isnan(v) else v for v in log.y.tolist()]]
    return [[*head, *log.names], *map(list, zip(*columns, *numbers, strict=True))]


def workbook(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 10.0, 60.0, 3600.0))
    moments = [log.start + timedelta(seconds=float(t)) for t in log.at]
    kind = int(rng.integers(4))
    if kind == 0:
        rows = sheet(log, ["Time"], [moments])
    elif kind == 1:
        dates = [datetime(m.year, m.month, m.day) for m in moments]
        rows = sheet(log, ["Datum", "Uhrzeit"], [dates, [m.time() for m in moments]])
    elif kind == 2:
        rows = sheet(log, ["Zeit [min]"], [[t / 60.0 for t in log.at.tolist()]])
        rows.insert(0, ["Versuch 7"])
    else:
        rows = sheet(log, ["Time"], [[m.strftime("%d.%m.%Y %H:%M:%S") for m in moments]])
        rows.insert(1, [None, "V", "m"])
    return Written(".xlsx", [("Tabelle1", rows)], log)


def serial_days(rng: Rng) -> Written:
    log = new_log(rng, (60.0, 300.0, 600.0))
    first = (log.start.replace(second=0) - datetime(1899, 12, 30)) / timedelta(days=1)
    column = [first + t / 86400.0 for t in log.at.tolist()]
    name = str(rng.choice(["Date", "Timestamp", "time"]))
    if rng.random() < 0.5:
        return Written(".xlsx", [("Sheet1", sheet(log, [name], [column]))], log)
    return Written(".csv", text(log, [name], [[f"{c:.9f}" for c in column]]), log)


def groups(rng: Rng) -> Written:
    log = new_log(rng, (1.0, 60.0))
    moments = [log.start + timedelta(seconds=float(t)) for t in log.at]
    u, y = log.names
    head = [["", "Zone 1", None, "Zone 2", None], ["Time", u, y, u, y]]
    other = rng.normal(size=(len(log.u), 2)).round(3).tolist()
    rows = [[m, a, b, *more] for m, a, b, more in zip(moments, log.u.tolist(), log.y.tolist(),
                                                      other, strict=True)]  # fmt: skip
    log.names = (f"Zone 1 {u}", f"Zone 1 {y}")
    return Written(".xlsx", [("Sheet1", [*head, *rows])], log)


def doubled(rng: Rng) -> Written:
    log = new_log(rng, (1.0,))
    rows = sheet(log, ["Time"], [log.at.tolist()])
    rows = [[*row, row[1]] for row in rows]
    return Written(".xlsx", [("Sheet1", rows)], log, asked=True)


def unknown_unit(rng: Rng) -> Written:
    log = new_log(rng, (60.0,))
    head = str(rng.choice(["Time (ticks)", "Time [samples]", "t (fortnights)"]))
    return Written(".csv", text(log, [head], [[f"{t:g}" for t in log.at]]), log, asked=True)


def comments(rng: Rng) -> Written:
    log = new_log(rng, (0.5, 1.0, 10.0))
    above = ["# rig 4", "# operator: Ann", "# started 2021-03-05 10:00:00"]
    column = [f"{t:.2f}" for t in log.at]
    return Written(".txt", text(log, ["Time [s]"], [column], " " * 3 if rng.random() < 0 else "\t",
                                above=above, below=["# end of log"]), log)  # fmt: skip


KINDS: tuple[Callable[[Rng], Written], ...] = (
    iso, german, german_two_columns, no_seconds, american, british, one_day, days_or_months,
    unit_in_header, unit_in_header, unit_in_header, unit_row, unit_row, unit_behind, bare_seconds,
    epoch, epoch, compact, compact, compact_milliseconds, compact_days, two_numbers, campbell,
    labview, japanese, hobo, clock, twelve_hours, minutes_beside_date, minutes_alone,
    minutes_in_header, minutes_and_seconds, set_back, gaps, newest_first, historian, words,
    american_months, microcontroller, durations, iberian, finnish, workbook, workbook, serial_days,
    groups, doubled, unknown_unit, comments,
)  # fmt: skip


def write(made: Written, path: Path) -> None:
    if isinstance(made.content, bytes):
        path.write_bytes(made.content)
        return
    import openpyxl

    book = openpyxl.Workbook()
    book.remove(book.worksheets[0])
    for title, rows in made.content:
        page = book.create_sheet(title)
        for row in rows:
            page.append(row)
    book.save(path)


def outcome(made: Written, path: Path) -> tuple[str, str]:
    """`right`, `asked` or `wrong`, and the question or what is wrong."""
    wanted = Wanted((made.log.names[0],), (made.log.names[1],))
    try:
        found = take_in([path], wanted, "train")
    except UserError as error:
        return "asked", str(error)
    step = found.records[0].sampling_time
    if made.asked and abs(step - made.log.step) > 1e-6 * made.log.step:
        return "wrong", f"{step:g} s without a question; {found.readings}"
    if abs(step - made.log.step) > 1e-6 * made.log.step:
        return "wrong", f"{step:g} s, not {made.log.step:g} s; {found.readings}"
    truth = made.log.records()
    if [len(r) for r in found.records] != [len(u) for u, _ in truth]:
        return "wrong", f"records of {[len(r) for r in found.records]} samples; {found.notes}"
    for record, (u, y) in zip(found.records, truth, strict=True):
        same_y = np.array_equal(record.measured_y[:, 0], y, equal_nan=True)
        if not np.array_equal(record.u[:, 0], u) or not same_y:
            return "wrong", "other values"
    return "right", ""


def run(files: int, seed: int, folder: Path) -> list[tuple[str, bool, str, str]]:
    """Kind, whether a question was due, outcome and text of each file."""
    found: list[tuple[str, bool, str, str]] = []
    for k in range(files):
        kind = KINDS[k % len(KINDS)]
        made = kind(np.random.default_rng([seed, k]))
        path = folder / f"log{k}{made.suffix}"
        write(made, path)
        found.append((kind.__name__, made.asked, *outcome(made, path)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--show", action="store_true", help="print every question")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(options.files, options.seed, Path(folder))
    for kind, due, result, why in found:
        if result == "wrong" or (result == "asked" and (options.show or not due)):
            print(f"{result:6} {kind:22} {'(ambiguous) ' if due else ''}{why}")
    count = Counter((result, due) for _, due, result, _ in found)
    due = sum(one[1] for one in found)
    print(
        f"{len(found)} files, {due} of them ambiguous: {count['right', False]} right, "
        f"{count['asked', False]} asked without need, {count['asked', True]} ambiguous ones asked, "
        f"{count['wrong', False] + count['wrong', True]} silently wrong, "
        f"{count['right', True]} ambiguous ones read as their writer meant without a question"
    )


if __name__ == "__main__":
    main()
