"""Take 60 ugly records through every command: each command ends in a result or in one sentence.

python benchmarks/ugly_records.py --out /tmp/ugly [--only 5,17] [--commands init,check]
    [--every 5] [--jobs 2] [--seed 0] [--read]

A second-order system with a saturated input is simulated from a seed. Its records are written as
laboratories write them: gaps, missing values, jitter, locales, odd headers, several rates, dates.
Each record goes through `asia init`, `check`, `run`, `status`, `show`, `validate`, `report` and
`export --to numpy`. Every fifth also goes through `SystemIdentifier`, and its search has 3
experiments; the other searches have 1. Where `init` refuses the record, the commands after it are
left out. A command fails if it prints a traceback or a warning of Python, if its exit code is not
0, 2 or, for a search without a score, 3, or if it gives no sentence with exit code 2. Each result
is a JSON line in OUT/results.jsonl. The same command resumes, and --read prints the table of the
results there. The exit code is 1 on any failure.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
COMMANDS = ("init", "check", "run", "status", "show", "validate", "report", "export", "identifier")
DOCUMENTED = {"run": (0, 2, 3)}
LIMIT_SECONDS = 420
FIT_SECONDS = 10
SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass
class Record:
    """Times (T,) in s, inputs (T, nu) and outputs (T, ny) as the files hold them."""

    t: Array
    u: Array
    y: Array
    names: list[str]
    """Column names, the time first."""

    @property
    def columns(self) -> Array:
        return np.column_stack([self.t, self.u, self.y])

    @property
    def channels(self) -> tuple[list[str], list[str]]:
        nu = self.u.shape[1]
        return self.names[1 : 1 + nu], self.names[1 + nu :]

    def rows(self, keep: Any) -> Record:
        return Record(self.t[keep], self.u[keep], self.y[keep], self.names)

    def named(self, *names: str) -> Record:
        return Record(self.t, self.u, self.y, list(names))


@dataclass
class Case:
    """A folder with files, and the options of `asia init` that a user would give."""

    name: str
    write: Callable[[Path, np.random.Generator], tuple[Record | None, Sequence[str]]]
    """Writes the files; returns the record for `SystemIdentifier` and the options."""
    number: int = field(default=0)


CASES: list[Case] = []


def case(name: str) -> Callable[[Any], Any]:
    def register(write: Any) -> Any:
        CASES.append(Case(name, write, len(CASES) + 1))
        return write

    return register


def simulated(
    rng: np.random.Generator, count: int = 240, nu: int = 1, ny: int = 1, step: float = 0.1
) -> Record:
    """A lightly damped second-order system with a saturated input; further outputs are mixtures."""
    steps = np.repeat(rng.normal(0, 1, (count // 6 + 1, nu)), 6, axis=0)[:count]
    u = np.round(steps, 3)
    drive = np.clip(u, -1.2, 1.2) @ (1.0 / (1 + np.arange(nu)))
    x = np.zeros(2)
    states = np.empty((count, 2))
    for k in range(count):
        states[k] = x
        h = step / 4
        for _ in range(4):
            x = x + h * np.array([x[1], 4.0 * (drive[k] - x[0]) - 1.6 * x[1]])
    y = states @ np.array([[1.0, 0.4], [0.0, 0.3]])[:, :ny]
    y = np.round(y + rng.normal(0, 0.01, y.shape), 4)
    inputs = ["u"] if nu == 1 else [f"u{i + 1}" for i in range(nu)]
    outputs = ["y"] if ny == 1 else [f"y{i + 1}" for i in range(ny)]
    return Record(np.round(step * np.arange(count), 6), u, y, ["t", *inputs, *outputs])


def cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.10g}"


def text(
    r: Record,
    sep: str = ",",
    stamp: Callable[[float], str] = cell,
    value: Callable[[float], str] = cell,
    header: str | None = None,
) -> list[str]:
    """Lines of a table."""
    lines = [sep.join(r.names) if header is None else header] if header != "" else []
    for t, *values in r.columns:
        lines.append(sep.join([stamp(t), *map(value, values)]))
    return lines


def write(folder: Path, lines: Iterable[str], name: str = "log.csv", end: str = "\n") -> None:
    (folder / name).write_bytes((end.join(lines) + end).encode())


def options(r: Record, name: str = "log.csv", *more: str) -> list[str]:
    """The options that name the file and its columns."""
    u, y = r.channels
    return ["--train", name, "--inputs", ",".join(u), "--outputs", ",".join(y), "--yes", *more]


GUESSED = ["--train", "log.csv", "--yes"]
Made = tuple[Record | None, Sequence[str]]
Rng = np.random.Generator
START = datetime(2026, 3, 29, 0, 59, 50, tzinfo=UTC)


def german(value: float) -> str:
    """With a decimal comma and points between thousands."""
    if np.isnan(value):
        return ""
    return f"{value:,.4f}".translate(str.maketrans(",.", ".,"))


def dated(shape: str) -> Callable[[float], str]:
    return lambda t: (START + timedelta(seconds=float(t))).strftime(shape)


def blank(values: Array, rng: Rng, share: float) -> Array:
    return np.where(rng.random(values.shape) < share, np.nan, values)


def plain(folder: Path, r: Record) -> Made:
    write(folder, text(r))
    return r, options(r)


@case("clean, columns guessed")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, text(r))
    return r, GUESSED


@case("gaps in time")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 400)
    k = np.arange(400)
    return plain(folder, r.rows((k < 150) | ((k > 170) & (k < 300)) | (k > 305)))


@case("gaps every few samples")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng, 400).rows(np.arange(400) % 9 < 6))


@case("empty cells in an output")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 300)
    r.y = blank(r.y, rng, 0.15)
    return plain(folder, r)


@case("empty cells in an input")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 300)
    r.u = blank(r.u, rng, 0.01)
    return plain(folder, r)


@case("words for missing values in both")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 400)
    r.u[200:203] = np.nan
    r.y = blank(r.y, rng, 0.05)
    words = ["NaN", "n.a.", "#N/A", "-", "NULL", "Bad"]
    count = iter(range(10**6))
    write(folder, text(r, value=lambda v: words[next(count) % 6] if np.isnan(v) else cell(v)))
    return r, options(r)


@case("every second input missing")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.u[1::2] = np.nan
    return plain(folder, r)


@case("jitter of 0.5 %")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.t = r.t + rng.normal(0, 0.0002, len(r.t))
    return plain(folder, r)


@case("jitter of 15 %")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.t = r.t + rng.uniform(-0.015, 0.015, len(r.t))
    return plain(folder, r)


@case("units in headers and cells")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng).named("t [s]", "valve [%]", "level (cm)")
    lines = [f"{cell(t)} s,{cell(u)} %,{cell(y)} cm" for t, u, y in r.columns]
    write(folder, [",".join(r.names), *lines])
    return r, ["--train", "log.csv", "--inputs", "valve", "--outputs", "level", "--yes"]


@case("a constant input beside a moving one")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, nu=2)
    r.u[:, 1] = 3.5
    return plain(folder, r)


@case("the only input constant")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.u[:] = 1.0
    return plain(folder, r)


@case("a constant output")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.y[:] = 20.0
    return plain(folder, r)


@case("two rates in one file")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 400)
    r.y[np.arange(400) % 5 > 0] = np.nan
    return plain(folder, r)


@case("inputs and outputs in alternating rows")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 400)
    r.u[::2], r.y[1::2] = np.nan, np.nan
    return plain(folder, r)


@case("duplicated time stamps")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    return plain(folder, r.rows(np.sort(np.concatenate([np.arange(240), [50, 120, 121]]))))


@case("rounded time stamps that repeat")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.t = np.floor(r.t)
    return plain(folder, r)


@case("time goes back twice")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 360)
    r.t = r.t % 12.0
    return plain(folder, r)


@case("rows shuffled")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng).rows(rng.permutation(240)))


@case("newest row first")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng).rows(slice(None, None, -1)))


@case("German locale with thousands points")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng).named("Zeit", "Drehzahl", "Druck")
    r.u, r.y = r.u * 2000 + 5000, r.y * 1500 + 12000
    write(folder, text(r, ";", german, german))
    return r, options(r)


@case("decimal comma between commas")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, text(r, ",", lambda t: german(t), german))
    return r, options(r)


def _mat(r: Record) -> dict[str, Any]:
    return {"t": r.t[:, None], "u": r.u, "y": r.y}


@case("MAT v5 struct")
def _(folder: Path, rng: Rng) -> Made:
    from scipy.io import savemat

    r = simulated(rng, nu=2, ny=2)
    savemat(folder / "log.mat", {"data": _mat(r)})
    return r, ["--train", "log.mat", "--inputs", "u", "--outputs", "y", "--yes"]


@case("MAT v7.3 struct")
def _(folder: Path, rng: Rng) -> Made:
    import h5py

    r = simulated(rng)
    with h5py.File(folder / "log.mat", "w", userblock_size=512) as file:
        group = file.create_group("data")
        for name, values in _mat(r).items():
            group[name] = values.T
    with (folder / "log.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return r, ["--train", "log.mat", "--inputs", "u", "--outputs", "y", "--yes"]


@case("NPZ with N x 2 arrays and a sampling time")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, nu=2, ny=2)
    np.savez(folder / "log.npz", u=r.u, y=r.y)
    names = ["--inputs", "u", "--outputs", "y", "--sampling-time", "0.1"]
    return r, ["--train", "log.npz", *names, "--yes"]


@case("NPZ with 2 x N arrays")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, nu=2, ny=2)
    np.savez(folder / "log.npz", u=r.u.T, y=r.y.T)
    names = ["--inputs", "u", "--outputs", "y", "--sampling-time", "0.1"]
    return r, ["--train", "log.npz", *names, "--yes"]


def _excel(path: Path, rows: Iterable[Sequence[Any]]) -> None:
    from openpyxl import Workbook

    book = Workbook()
    sheet: Any = book.active
    for row in rows:
        sheet.append(list(row))
    book.save(path)


@case("Excel with dates and a title above")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, step=1.0)
    dates = [(START + timedelta(seconds=float(t))).replace(tzinfo=None) for t in r.t]
    body = [(d, float(u), float(y)) for d, (_, u, y) in zip(dates, r.columns, strict=True)]
    _excel(folder / "log.xlsx", [("Rig 4",), (), ("Date", "Valve", "Level"), *body])
    names = ["--inputs", "Valve", "--outputs", "Level"]
    return r, ["--train", "log.xlsx", *names, "--yes"]


@case("Excel with texts for numbers and empty rows")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    body: list[Sequence[Any]] = [tuple(german(v) for v in row) for row in r.columns]
    body[100:100] = [(), (None, None, None)]
    _excel(folder / "log.xlsx", [("t", "u", "y", None), *body, (), ()])
    return r, options(r, "log.xlsx")


@case("Parquet with dates and missing values")
def _(folder: Path, rng: Rng) -> Made:
    import pyarrow as pa
    import pyarrow.parquet as pq

    r = simulated(rng, 300)
    r.y = blank(r.y, rng, 0.1)
    dates = [START + timedelta(seconds=float(t)) for t in r.t]
    outputs = [None if np.isnan(v) else float(v) for v in r.y[:, 0]]
    table: Any = pa.table({"time": dates, "u": r.u[:, 0], "y": outputs})
    pq.write_table(table, folder / "log.parquet")
    return r, options(r, "log.parquet")


@case("wide file with a column of experiments")
def _(folder: Path, rng: Rng) -> Made:
    every = [simulated(rng, 120) for _ in range(3)]
    lines = ["run,t,u,y"]
    for k, r in enumerate(every):
        lines += [f"step {k},{line}" for line in text(r, header="")]
    write(folder, lines)
    return every[0], options(every[0], "log.csv", "--experiment-column", "run")


@case("wide file, the column of experiments not named")
def _(folder: Path, rng: Rng) -> Made:
    every = [simulated(rng, 120) for _ in range(3)]
    lines = ["run,t,u,y"]
    for k, r in enumerate(every):
        lines += [f"{k},{line}" for line in text(r, header="")]
    write(folder, lines)
    return every[0], GUESSED


@case("text columns beside the channels")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, ["t,u,y,state,operator", *(f"{x},ok,Ann" for x in text(r, header=""))])
    return r, GUESSED


@case("a text column as an output")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, ["t,u,y", *(f"{cell(t)},{cell(u)},open" for t, u, _ in r.columns)])
    return None, options(r)


@case("trailing empty columns and rows")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, [*(f"{line};;;" for line in text(r, ";")), ";;;;;", ";;;;;", "", ""])
    return r, GUESSED


@case("blank lines in the middle")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    lines = text(r)
    lines[60:60], lines[150:150] = [""], ["", "   ", ""]
    write(folder, lines)
    return r, options(r)


@case("byte order mark and CRLF")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    lines = text(r)
    write(folder, ["\ufeff" + lines[0], *lines[1:]], end="\r\n")
    return r, options(r)


@case("UTF-16 with tabs")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    (folder / "log.csv").write_bytes("\r\n".join(text(r, "\t")).encode("utf-16"))
    return r, options(r)


@case("comments before the header")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, ["# rig 4", "% date: 2026-03-29", "// gain = 2, offset = 3", *text(r)])
    return r, options(r)


@case("names and units in two rows")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng).named("Time", "Motor Voltage", "Tip Angle")
    write(folder, [",".join(r.names), "s,V,deg", *text(r, header="")])
    return r, options(r)


@case("no header, no names given")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, text(r, header=""))
    return r, GUESSED


@case("no header, names given")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, text(r, header=""))
    return r, options(r, "log.csv", "--columns", "t,u,y")


@case("huge values")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.u, r.y = r.u * 1e12, r.y * 1e155
    return plain(folder, r)


@case("tiny values with a large offset")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.y = 1e5 + np.round(r.y, 2) * 1e-4
    return plain(folder, r)


@case("whole numbers only")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.t, r.u, r.y = np.arange(240.0), np.round(r.u * 10), np.round(r.y * 4)
    return plain(folder, r)


@case("ten samples")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng, 10))


@case("one sample")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng, 1))


@case("two identical outputs")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, ny=2)
    r.y[:, 1] = r.y[:, 0]
    return plain(folder, r)


@case("an input without effect")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    u = np.column_stack([r.u, np.round(rng.normal(0, 1, 240), 3)])
    return plain(folder, Record(r.t, u, r.y, ["t", "u1", "u2", "y"]))


@case("names with blanks, umlauts, keywords and duplicates that differ by case")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, nu=2, ny=2)
    return plain(folder, r.named("Zeit (s)", "class", "Ventil Öffnung", "Füllstand 1", "lambda"))


@case("two columns of the same name")
def _(folder: Path, rng: Rng) -> Made:
    return plain(folder, simulated(rng, nu=2).named("t", "u", "u", "y"))


@case("time in ms, named without a unit")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    write(folder, text(r, stamp=lambda t: f"{1000 * t:.0f}", header="time_ms,u,y"))
    return r, GUESSED


@case("ISO time with a zone over the end of winter time")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, step=1.0)

    def stamp(t: float) -> str:
        at = START + timedelta(seconds=float(t))
        hours = 1 if t < 10 else 2
        return (at + timedelta(hours=hours)).strftime("%Y-%m-%dT%H:%M:%S") + f"+0{hours}:00"

    write(folder, text(r, stamp=stamp))
    return r, options(r)


@case("sampling time that drifts")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.t = np.round(np.cumsum(np.linspace(0.1, 0.14, 240)), 6)
    return plain(folder, r)


@case("an output missing for a third of the record")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 360, ny=2)
    r.y[120:240, 0] = np.nan
    return plain(folder, r)


@case("no output measured in the whole record")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.y[:] = np.nan
    return plain(folder, r)


@case("an infinite value")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng)
    r.y[77] = np.inf
    return plain(folder, r)


@case("German dates, units row, gap and missing outputs")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 360, step=1.0).named("Zeit", "Öffnung", "Füllstand")
    r.y = blank(r.y, rng, 0.05)
    r = r.rows(np.r_[0:180, 200:360])
    lines = text(r, ";", dated("%d.%m.%Y %H:%M:%S"), german)
    write(folder, ["\ufeff" + lines[0], ";%;cm", *lines[1:]], end="\r\n")
    return r, options(r)


@case("jitter, duplicated stamps and empty cells")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 300)
    r.t = np.round(r.t + rng.uniform(-0.01, 0.01, 300), 4)
    r.t[[90, 200]] = r.t[[89, 199]]
    r.y, r.u = blank(r.y, rng, 0.03), blank(r.u, rng, 0.005)
    return plain(folder, r)


@case("two files of two rates and two orders of columns")
def _(folder: Path, rng: Rng) -> Made:
    a, b = simulated(rng, 200), simulated(rng, 300, step=0.05)
    write(folder, text(a), "a.csv")
    write(folder, ["y,t,u", *(f"{cell(y)},{cell(t)},{cell(u)}" for t, u, y in b.columns)], "b.csv")
    return a, [*options(a, "a.csv"), "--train", "b.csv"]


@case("ten samples, a constant input and a missing output")
def _(folder: Path, rng: Rng) -> Made:
    r = simulated(rng, 10)
    r.u[:], r.y[4] = 1.0, np.nan
    return plain(folder, r)


# --- running -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """One command on one case."""

    case: int
    name: str
    command: str
    code: int
    seconds: float
    output: str

    @property
    def failure(self) -> str:
        """Why this is a defect; "" where it is none."""
        if "Traceback" in self.output or "internal error" in self.output:
            return "traceback"
        if "Warning: " in self.output:
            return "warning of Python"
        if self.code not in DOCUMENTED.get(self.command, (0, 2)):
            return f"exit code {self.code}"
        if self.code == 2 and not self.message:
            return "no sentence"
        return ""

    @property
    def message(self) -> str:
        """The last line that is printed."""
        lines = [line for line in self.output.strip().splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""


def prepare(one: Case, home: Path, seed: int) -> tuple[Record | None, Sequence[str]]:
    """Write the files of a case anew."""
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    return one.write(home, np.random.default_rng([seed, one.number]))


def run_command(one: Case, command: str, home: Path, seed: int, full: bool) -> Outcome:
    """Run one command of a case in its folder."""
    asia = [sys.executable, "-m", "asia"]
    experiments = "3" if full else "1"
    if command == "init":
        _, given = prepare(one, home, seed)
        words = [*asia, "init", "problem", *given]
    elif command == "identifier":
        me = str(Path(__file__).resolve())
        words = [sys.executable, me, "--identify", str(one.number), "--seed", str(seed)]
    else:
        words = {
            "check": ["check", "problem"],
            "run": ["run", "problem", "--experiments", experiments, "--retests", "0"],
            "export": ["export", "--to", "numpy"],
        }.get(command, [command])
        words = [*asia, *words]
    env = os.environ | SINGLE_THREAD | {"ASIA_KEYS": str(home / "keys"), "COLUMNS": "200"}
    began = time.monotonic()
    try:
        done = subprocess.run(
            ["nice", *words],
            cwd=home,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=LIMIT_SECONDS,
            check=False,
        )
        code, output = done.returncode, done.stdout.decode(errors="replace")
    except subprocess.TimeoutExpired as late:
        code, output = -1, (late.stdout or b"").decode(errors="replace")
    if command == "init" and code == 0:
        shorten_fits(home / "problem" / "problem.toml")
    seconds = round(time.monotonic() - began, 2)
    return Outcome(one.number, one.name, command, code, seconds, output[-6000:])


def shorten_fits(path: Path) -> None:
    """Limit the time of a fit in problem.toml."""
    path.write_text(path.read_text().replace("fit_seconds = 120 ", f"fit_seconds = {FIT_SECONDS} "))


def identify(one: Case, seed: int) -> int:
    """Give the arrays of a case to SystemIdentifier; the exit code of a command line."""
    import asia
    from asia.errors import UserError

    r, _ = one.write(Path.cwd() / "again", np.random.default_rng([seed, one.number]))
    if r is None:
        print("left out: this case has no arrays of numbers")
        return 0
    budget = {"fit_seconds": FIT_SECONDS}
    found = asia.SystemIdentifier(1, budget=budget, runs="runs-identifier", progress=False)
    step = float(np.median(np.abs(np.diff(r.t)))) if len(r.t) > 1 else 0.1
    inputs, outputs = r.channels
    try:
        found.fit(r.u, r.y, sampling_time=step, inputs=inputs, outputs=outputs)
    except UserError as error:
        print(f"error: {error}")
        return 2
    print(f"V {found.value_}")
    return 0


def run_case(
    one: Case, out: Path, wanted: Sequence[str], done: dict[tuple[int, str], Outcome], seed: int,
    every: int, write_line: Callable[[Outcome], None],
) -> None:  # fmt: skip
    """Run the commands of a case that have no result. They run also after a refused one, except
    after `init`: without a problem all would say the same."""
    home = out / f"case{one.number:02d}"
    full = one.number % every == 0
    for command in COMMANDS:
        if command not in wanted or (one.number, command) in done:
            continue
        if command == "identifier":
            if not full:
                continue
            (home / "again").mkdir(parents=True, exist_ok=True)
        elif command != "init":
            first = done.get((one.number, "init"))
            if first is None or first.code != 0:
                continue
        outcome = run_command(one, command, home, seed, full)
        done[one.number, command] = outcome
        write_line(outcome)


def read(path: Path) -> dict[tuple[int, str], Outcome]:
    if not path.is_file():
        return {}
    lines = [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    return {(o["case"], o["command"]): Outcome(**o) for o in lines}


def table(done: dict[tuple[int, str], Outcome]) -> str:
    """Every case with the exit code of each command, then the sentences of refusals."""
    lines = io.StringIO()
    print(f"| case | {' | '.join(COMMANDS)} |", file=lines)
    print("|---" * (len(COMMANDS) + 1) + "|", file=lines)
    for one in CASES:
        found = [done.get((one.number, command)) for command in COMMANDS]
        if any(found):
            cells = ["" if o is None else o.failure or str(o.code) for o in found]
            print(f"| {one.number} {one.name} | {' | '.join(cells)} |", file=lines)
    failures = [o for o in done.values() if o.failure]
    print(file=lines)
    for o in sorted(done.values(), key=lambda o: (o.case, COMMANDS.index(o.command))):
        if o.code or o.failure:
            print(
                f"- {o.case} {o.command}: {o.failure and o.failure + ': '}{o.message}", file=lines
            )
    tracebacks = sum(o.failure == "traceback" for o in failures)
    refused = sum(o.code != 0 for o in done.values())
    cases = len({o.case for o in done.values()})
    print(f"\n{cases} cases, {len(done)} commands, {refused} with an exit code other", file=lines)
    print(f"than 0, {tracebacks} tracebacks, {len(failures)} failures", file=lines)
    return lines.getvalue()


def main() -> int:
    """Run what is missing and print the table; 1 on any failure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/ugly"))
    parser.add_argument("--only", default="", help="numbers of cases, in the order to run them")
    parser.add_argument("--commands", default=",".join(COMMANDS))
    parser.add_argument("--every", type=int, default=5, help="3 experiments in every Nth case")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--read", action="store_true", help="print the table of what is there")
    parser.add_argument("--identify", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.identify:
        return identify(CASES[given.identify - 1], given.seed)
    out: Path = given.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    done = read(out / "results.jsonl")
    lock = Lock()

    def write_line(outcome: Outcome) -> None:
        with lock, (out / "results.jsonl").open("a") as file:
            file.write(json.dumps(outcome.__dict__) + "\n")

    if not given.read:
        numbers = [int(n) for n in given.only.split(",") if n]
        chosen = [CASES[n - 1] for n in numbers] or CASES
        wanted = given.commands.split(",")
        with ThreadPoolExecutor(given.jobs) as pool:
            ends = [
                pool.submit(run_case, c, out, wanted, done, given.seed, given.every, write_line)
                for c in chosen
            ]
            for end in ends:
                end.result()
    print(table(done))
    return int(any(o.failure for o in done.values()))


if __name__ == "__main__":
    sys.exit(main())
