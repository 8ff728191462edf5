"""Numbers follow their signals at every door: scaled, shifted, negated, permuted and renamed
signals, reordered records and another unit of time change only the numbers that carry the unit. Of
sentences only the words are compared."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from asia.analysis.data_verdict import judge_data
from asia.data import Array
from asia.problem.check import check_problem
from asia.problem.problem import Problem
from asia.problem.seal import seal
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import unpainted

STEP = 0.5
INPUTS, OUTPUTS = ("pump", "valve"), ("level", "pressure")
OTHERS = {"pump": "alpha", "valve": "beta", "level": "gamma", "pressure": "delta"}


@dataclass(frozen=True)
class Transformation:
    """Signals that a user could have recorded instead: plus a shift, times factors."""

    y: tuple[float, float] = (1.0, 1.0)
    u: tuple[float, float] = (1.0, 1.0)
    y_shift: float = 0.0
    u_shift: float = 0.0
    time: float = 1.0
    permuted: bool = False
    renamed: bool = False
    reordered: bool = False

    def record(self, seed: int, samples: int = 260) -> tuple[Array, Array]:
        """Inputs and outputs (T, 2) of a record."""
        u, y = record(seed, samples)
        way = -1 if self.permuted else 1
        return ((u + self.u_shift) * self.u)[:, ::way], ((y + self.y_shift) * self.y)[:, ::way]

    def records(self) -> tuple[list[Array], list[Array]]:
        pairs = [self.record(seed) for seed in ((2, 1) if self.reordered else (1, 2))]
        return [u for u, _ in pairs], [y for _, y in pairs]

    def names(self, names: tuple[str, str]) -> list[str]:
        found = [OTHERS[n] for n in names] if self.renamed else list(names)
        return found[::-1] if self.permuted else found

    def write(self, seed: int, path: Path, samples: int = 260) -> Path:
        """A record as a file."""
        names = [*self.names(INPUTS), *self.names(OUTPUTS)]
        table = np.hstack(self.record(seed, samples))
        np.savetxt(path, table, "%.17g", ",", header=",".join(names), comments="")
        return path


TRANSFORMATIONS = {
    "outputs times 1e12": Transformation(y=(1e12, 1e12)),
    "records reordered": Transformation(reordered=True),
}
# Several changes at once.
TOGETHER = {
    "another unit": Transformation(
        (1e-9, 1e6), (1e9, 1e-3), y_shift=100.0, u_shift=-30.0, time=1e-6, renamed=True
    ),
    "another direction": Transformation((-1.0, 1e12), (1.0, -1.0), time=60.0, permuted=True),
}


def record(seed: int, samples: int = 260) -> tuple[Array, Array]:
    """Inputs and outputs (T, 2) of a linear system of third order with delays."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(samples // 4 + 1, 2)), 4, axis=0)[:samples]
    y = np.zeros((samples, 2))
    for k in range(2, samples):
        y[k, 0] = 1.2 * y[k - 1, 0] - 0.35 * y[k - 2, 0] + 0.4 * u[k - 1, 0] + 0.2 * u[k - 1, 1]
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * u[k - 2, 1]
    return u, y + 0.02 * rng.normal(size=y.shape)


# The comparison.

# Dimension of the numbers at a path: y of output (?P<o>), u of input (?P<i>), t of time, y0 and u0
# of those that the loop has, in a product over a product; + moves with the origin, | has no sign,
# @ is a value at inputs of 0, which another origin of the inputs moves too. No law: a pure number.
DIMENSIONS = {
    r"(?<!_)sampling_time$": "t",
    # Signals of a check, and the proposed model.
    r"^inputs\.(?P<i>\d)\.(minimum|maximum)": "u+",
    r"^inputs\.(?P<i>\d)\.std": "|u",
    r"^outputs\.(?P<o>\d)\.(minimum|maximum)": "y+",
    r"^outputs\.(?P<o>\d)\.std": "|y",
    r"^(in|out)puts\.(?P<i>\d)\.bandwidth$": "/t",
    r"^(in|out)puts\.(?P<i>\d)": "",
    r"proposal\.time_constants": "t",
    # Process models of records.
    r"of_records\.(?P<o>\d)\.models\.(?P<i>\d)\.gain": "y/u",
    r"of_records\.(?P<o>\d)\.models\.(?P<i>\d)\.(lags|zero|delay)": "t",
    r"of_records\.(?P<o>\d)\.models\.(?P<i>\d)": "",
    r"of_records\.(?P<o>\d)\.parameters\.(?P<i>\d)\.0\.\w+_error": "|y/u",
    r"of_records\.(?P<o>\d)\.parameters\.(?P<i>\d)\.0\.(value|low|high|lower|upper)": "y/u",
    r"of_records\.(?P<o>\d)\.parameters\.(?P<i>\d)\.\d\.(?!data|at)\w+$": "t",
    r"of_records\.(?P<o>\d)\.(first|withheld)\.(?P<i>\d)": "",
    r"of_records\.(?P<o>\d)\.offset": "y+@",
    r"of_records\.(?P<o>\d)": "",
    # Models of a frequency response, in continuous time.
    r"^response\.delay": "t",
    r"^response\.(poles|zeros)\.\d\.(real|imag)": "/t",
    # Linear models.
    r"\.u\.(?P<i>\d)$": "u+",
    r"\.y\.(?P<o>\d)$": "y+",
    r"(frequency_hz|frequency_band\.\d)$": "/t",
    r"continuous\.(poles|zeros)\.\d\.(real|imag)": "/t",
    r"time_s$": "t",
    r"\.(gain|numerators)\.(?P<o>\d)\.(?P<i>\d)": "y/u",
    r"fold_gains\.\d\.(?P<o>\d)\.(?P<i>\d)": "y/u",
    r"\.gains\.(?P<o>\d)\.(?P<i>\d)\.(value|interval)": "y/u",
    r"(gains|delay_samples)\.(?P<o>\d)\.(?P<i>\d)": "",
}  # fmt: skip
LAWS = [(re.compile(pattern), dimension) for pattern, dimension in DIMENSIONS.items()]
ENDS = {"low": "high", "minimum": "maximum", "at_minimum": "at_maximum", "lower": "upper"}
ENDS |= {"min": "max"}
ENDS |= {high: low for low, high in ENDS.items()}
PAIRS = re.compile(r"((?:interval|interval_95|range|band)\.)([01])\b")
NUMBER = re.compile(r"[-+]?\b\d+(\.\d+)?(e[-+]?\d+)?\b|[-+]?\binf\b")


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        parts = list(value.items())
    elif isinstance(value, (list, tuple)):
        parts = list(enumerate(value))
    else:
        yield path, value
        return
    for key, part in parts:
        yield from leaves(part, f"{path}.{key}" if path else str(key))


def as_original(document: Any, of: Transformation) -> dict[str, Any]:
    """Leaves of a document by their paths, in the units and with the names of the original."""
    found: dict[str, Any] = {}
    for path, value in leaves(document):
        match, dimension = next(((m, d) for p, d in LAWS if (m := p.search(path))), (None, ""))
        if "@" in dimension and of.u_shift:
            value = ...
        places: dict[str, int] = {}
        for name in match.groupdict() if match is not None else ():
            places[name] = int(match[name])
            if of.permuted:
                start, end = match.span(name)
                path = f"{path[:start]}{1 - places[name]}{path[end:]}"
                places[name] = 1 - places[name]
        factor = 1.0
        above, _, below = dimension.partition("/")
        for side, power in ((above, 1.0), (below, -1.0)):
            for signal, number in re.findall(r"([yut])(\d?)", side):
                if signal == "t":
                    factor *= of.time**power
                else:
                    place = int(number) if number else places["o" if signal == "y" else "i"]
                    factor *= getattr(of, signal)[place] ** power
        signs = factor
        if match is not None and not dimension and re.match(r"(in|out)puts", path):
            signs = (of.u if path.startswith("inputs") else of.y)[places["i"]]
        if signs < 0 and "|" not in dimension:
            path = PAIRS.sub(lambda m: f"{m[1]}{1 - int(m[2])}", path)
            path = ".".join(ENDS.get(key, key) for key in path.split("."))
        if isinstance(value, str):
            value = as_text(value, of)
        elif isinstance(value, float) or (isinstance(value, int) and dimension):
            shift = getattr(of, f"{dimension[0]}_shift") if "+" in dimension else 0.0
            value = value / (abs(factor) if "|" in dimension else factor) - shift
        found[path] = value
    return found


def differences(here: dict[str, Any], there: dict[str, Any], tolerance: float) -> list[str]:
    found = [f"{p}: only in one" for p in here.keys() ^ there.keys()]
    for path in here.keys() & there.keys():
        a, b = here[path], there[path]
        if ... in (a, b):
            continue
        if isinstance(a, float) and isinstance(b, float):
            if not (abs(a - b) <= tolerance * max(abs(a), abs(b), 1e-3) or (a != a and b != b)):
                found.append(f"{path}: {a!r} and {b!r}")
        elif a != b:
            found.append(f"{path}: {a!r} and {b!r}")
    return sorted(found)


def as_text(line: str, of: Transformation) -> str:
    """Words of a line without numbers and digests, in an order that no channel decides."""
    back = {new: old for old, new in OTHERS.items()} if of.renamed else {}
    line = re.sub(r"(protocol |records-)\w+", r"\1", line).replace(" - ", " + ")
    words = re.sub(r"[(),:;]", " ", line).split()
    return " ".join(
        sorted(NUMBER.sub("#", re.sub(r"\w+", lambda m: back.get(m[0], m[0]), w)) for w in words)
    )


# The doors.


def checked(of: Transformation, folder: Path) -> Any:
    """`asia check`, as numbers and as lines."""
    u, y = of.records()
    problem = Problem.from_arrays(
        u, y, sampling_time=STEP * of.time, directory=folder / "problem",
        inputs=of.names(INPUTS), outputs=of.names(OUTPUTS),
    )  # fmt: skip
    report = check_problem(problem, seal(problem))
    signals = [asdict(one) for one in report.signals]
    verdict = judge_data(problem, report)
    assert verdict.linear is not None
    linear = verdict.linear
    names = dict(zip(of.names(INPUTS), INPUTS[:: -1 if of.permuted else 1], strict=True))
    # Lines and doubts of channels come in the order of the channels.
    return {
        "inputs": signals[:2], "outputs": signals[2:],
        "proposal": {
            "order": linear.order,
            "order_errors": linear.order_errors,
            "delays": {names[name]: lag for name, lag in linear.delays.items()},
            "time_constants": linear.time_constants,
        },
        "weights": sorted(one.weight for one in report.doubts),
        "lines": sorted(as_text(one, of) for one in [*report.lines(), *verdict.lines()]),
    }  # fmt: skip


def linear_of_record(of: Transformation, folder: Path) -> Any:
    """`asia linear FILE`."""
    done = command_line(
        "linear", of.write(1, folder / "record.csv", 120), "--inputs", ",".join(of.names(INPUTS)),
        "--outputs", ",".join(of.names(OUTPUTS)), "--sampling-time", STEP * of.time,
        "--out", folder / "linear", "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    facts = json.loads(done.out)
    unordered(facts, of)
    return facts


def linear_of_response(of: Transformation, folder: Path) -> Any:
    """`asia linear FILE` of a frequency response."""
    rng = np.random.default_rng(0)
    frequency = np.geomspace(0.01, 0.9, 24)
    slow, fast = (1 / (1 + 2j * np.pi * frequency * time) for time in (3.0, 1.0))
    plain = np.array([2.0 * slow, 0.5 * fast, slow, 1.5 * fast])
    plain = plain * (1 + 0.01 * (rng.normal(size=(4, 24)) + 1j * rng.normal(size=(4, 24))))
    columns = {"frequency": frequency / of.time}
    way = -1 if of.permuted else 1
    for i in (0, 1)[::way]:
        for j in (0, 1)[::way]:
            pair = f"{_named(of, OUTPUTS)[i]}/{_named(of, INPUTS)[j]}"
            values = plain[2 * i + j] * of.y[i] / of.u[j]
            columns |= {f"{pair} real": values.real, f"{pair} imag": values.imag}
    table, path = np.stack(list(columns.values()), axis=1), folder / "response.csv"
    np.savetxt(path, table, "%.17g", ",", header=",".join(columns), comments="")
    done = command_line("linear", path, "--out", folder / "linear", "--json", "--to-tf")
    assert done.code == 0, done.err
    facts = json.loads(done.out)
    unordered(facts, of)
    return {"response": {key: facts[key] for key in facts if key not in "ABCD"}}


def unordered(facts: dict[str, Any], of: Transformation) -> None:
    """Take out names, whose order is that of the channels, and sort the lines."""
    for name in ("file", "inputs", "outputs", "run"):
        facts.pop(name, None)
    facts["text"] = sorted(as_text(one, of) for one in facts["text"])


def _named(of: Transformation, names: tuple[str, str]) -> list[str]:
    """Names of the channels in the order of the original."""
    return of.names(names)[:: -1 if of.permuted else 1]


DOORS: dict[str, Callable[[Transformation, Path], Any]] = {
    "check": checked,
    "linear FILE": linear_of_record,
    "linear RESPONSE": linear_of_response,
}


@cache
def original(door: str) -> dict[str, Any]:
    """Leaves of the signals as they are."""
    return as_original(DOORS[door](Transformation(), Path(mkdtemp())), Transformation())


QUICK = {("linear FILE", "another direction")}
CASES = [("check", name) for name in (*TRANSFORMATIONS, *TOGETHER)]
CASES += [(door, name) for door in ("linear FILE", "linear RESPONSE") for name in TOGETHER]


@pytest.mark.parametrize(
    ("door", "name"),
    [pytest.param(*c, marks=() if c in QUICK else pytest.mark.slow) for c in CASES],
)
def test_numbers_follow_their_signals(door: str, name: str, tmp_path: Path) -> None:
    of = (TRANSFORMATIONS | TOGETHER)[name]
    with unpainted():
        after = as_original(DOORS[door](of, tmp_path), of)
        assert not (found := differences(original(door), after, 1e-6)), "\n".join(found)
