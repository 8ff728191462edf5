"""The numbers of `asia check` follow their signals: scaled, shifted, negated, permuted and renamed
signals, reordered records and another unit of time change only the numbers that carry the unit.
Numbers of signals, weights and of the proposed model are compared; of sentences only the words."""

from __future__ import annotations

import re
from collections.abc import Iterator
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

STEP = 0.5
INPUTS, OUTPUTS = ("pump", "valve"), ("level", "pressure")
OTHERS = {"pump": "alpha", "valve": "beta", "level": "gamma", "pressure": "delta"}


@dataclass(frozen=True)
class Transformation:
    """Signals that a user could have recorded instead: times factors, plus a shift."""

    y: tuple[float, float] = (1.0, 1.0)
    u: tuple[float, float] = (1.0, 1.0)
    y_shift: float = 0.0
    u_shift: float = 0.0
    time: float = 1.0
    permuted: bool = False
    renamed: bool = False
    reordered: bool = False

    def record(self, seed: int) -> tuple[Array, Array]:
        """Inputs and outputs (T, 2) of a record."""
        u, y = record(seed)
        way = -1 if self.permuted else 1
        return (u * self.u + self.u_shift)[:, ::way], (y * self.y + self.y_shift)[:, ::way]

    def records(self) -> tuple[list[Array], list[Array]]:
        pairs = [self.record(seed) for seed in ((2, 1) if self.reordered else (1, 2))]
        return [u for u, _ in pairs], [y for _, y in pairs]

    def names(self, names: tuple[str, str]) -> list[str]:
        found = [OTHERS[n] for n in names] if self.renamed else list(names)
        return found[::-1] if self.permuted else found


TRANSFORMATIONS = {
    "outputs times 1e-12": Transformation(y=(1e-12, 1e-12)),
    "outputs times 1e12": Transformation(y=(1e12, 1e12)),
    "one output times 1e-9": Transformation(y=(1e-9, 1.0)),
    "one output times 1e6": Transformation(y=(1.0, 1e6)),
    "inputs times 1e-9": Transformation(u=(1e-9, 1e-9)),
    "one input times 1e9": Transformation(u=(1e9, 1.0)),
    "outputs shifted": Transformation(y_shift=100.0),
    "inputs shifted": Transformation(u_shift=-30.0),
    "one output negated": Transformation(y=(-1.0, 1.0)),
    "one input negated": Transformation(u=(1.0, -1.0)),
    "channels permuted": Transformation(permuted=True),
    "channels renamed": Transformation(renamed=True),
    "records reordered": Transformation(reordered=True),
    "time times 60": Transformation(time=60.0),
    "time times 1e-6": Transformation(time=1e-6),
}


def record(seed: int, samples: int = 260) -> tuple[Array, Array]:
    """Inputs and outputs (T, 2) of a linear system of third order with delays."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(samples // 4 + 1, 2)), 4, axis=0)[:samples]
    y = np.zeros((samples, 2))
    for k in range(2, samples):
        y[k, 0] = 1.2 * y[k - 1, 0] - 0.5 * y[k - 2, 0] + 0.4 * u[k - 1, 0] + 0.2 * u[k - 1, 1]
        y[k, 1] = 0.8 * y[k - 1, 1] + 0.3 * u[k - 2, 1]
    return u, y + 0.02 * rng.normal(size=y.shape)


# The comparison.

LAWS = [
    (re.compile(pattern), dimension)
    for pattern, dimension in {
        r"inputs\.(?P<i>\d)\.(minimum|maximum)": "u+",
        r"inputs\.(?P<i>\d)\.std": "u",
        r"inputs\.(?P<i>\d)\.bandwidth$": "/t",
        r"outputs\.(?P<o>\d)\.(minimum|maximum)": "y+",
        r"outputs\.(?P<o>\d)\.std": "y",
        r"outputs\.(?P<o>\d)\.bandwidth$": "/t",
        r"(in|out)puts\.(?P<i>\d)": "",
        r"proposal\.time_constants": "t",
    }.items()
]
ENDS = {"low": "high", "minimum": "maximum", "at_minimum": "at_maximum", "lower": "upper"}
ENDS |= {high: low for low, high in ENDS.items()}
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
    back = {new: old for old, new in OTHERS.items()}
    for path, value in leaves(document):
        law = next(((m, d) for p, d in LAWS if (m := p.search(path))), None)
        factor, shift, dimension = 1.0, 0.0, ""
        if law is not None:
            match, dimension = law
            places = {name: int(k) for name, k in match.groupdict().items()}
            if of.permuted:
                for name, k in places.items():
                    start, end = match.span(name)
                    path = f"{path[:start]}{1 - k}{path[end:]}"
                    places[name] = 1 - k
            if "y" in dimension:
                factor *= of.y[places["o"]]
                shift = of.y_shift if "+" in dimension else 0.0
            if "u" in dimension:
                factor *= of.u[places["i"]]
                shift = of.u_shift if dimension == "u+" else shift
            if "t" in dimension:
                factor *= of.time ** (-1.0 if "/t" in dimension else 1.0)
        signs = factor
        if not any(c in dimension for c in "yu") and law is not None and "i" in law[0].groupdict():
            side = of.u if path.startswith("inputs") else of.y
            signs = side[int(law[0].group("i"))]
        if signs < 0:
            path = ".".join(ENDS.get(key, key) for key in path.split("."))
        if isinstance(value, str):
            value = re.sub(r"\b\w+\b", lambda m: back.get(m[0], m[0]), value)
            value = NUMBER.sub("#", value)
        elif isinstance(value, float) or (isinstance(value, int) and dimension):
            value = (value - shift) / (abs(factor) if path.endswith("std") else factor)
        found[path] = value
    return found


def differences(here: dict[str, Any], there: dict[str, Any], tolerance: float) -> list[str]:
    found = [f"{p}: only in one" for p in here.keys() ^ there.keys()]
    for path in here.keys() & there.keys():
        a, b = here[path], there[path]
        if isinstance(a, float) and isinstance(b, float):
            if not (abs(a - b) <= tolerance * max(abs(a), abs(b), 1e-3) or (a != a and b != b)):
                found.append(f"{path}: {a!r} and {b!r}")
        elif a != b:
            found.append(f"{path}: {a!r} and {b!r}")
    return sorted(found)


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


def as_text(line: str, of: Transformation) -> str:
    """Words of a line without numbers and digests, in an order that no channel decides."""
    back = {new: old for old, new in OTHERS.items()} if of.renamed else {}
    words = re.sub(r"protocol \w+", "protocol", line).replace(",", " ").split()
    return " ".join(
        sorted(NUMBER.sub("#", re.sub(r"\w+", lambda m: back.get(m[0], m[0]), w)) for w in words)
    )


@cache
def original() -> dict[str, Any]:
    """Leaves of the signals as they are."""
    return as_original(checked(Transformation(), Path(mkdtemp())), Transformation())


@pytest.mark.slow
@pytest.mark.parametrize("name", TRANSFORMATIONS)
def test_numbers_of_check_follow_their_signals(name: str, tmp_path: Path) -> None:
    of = TRANSFORMATIONS[name]
    after = as_original(checked(of, tmp_path), of)
    assert not (found := differences(original(), after, 1e-6)), "\n".join(found)
