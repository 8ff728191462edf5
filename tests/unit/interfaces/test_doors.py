"""Two doors print one number: terminal text, --json, Python, the page and the metadata of an export
agree on every figure of a run, to the digits that they print."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asia
from asia.analysis.verdict import usability
from asia.ledger import run as ledger
from asia.ledger.run import model_to_use, open_run
from asia.problem.load import load_problem
from asia.report.page.page import write_page
from asia.search.run import prepare, search
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.painting import unpainted
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem

pytestmark = pytest.mark.slow

# Runs of different kinds, as changes of the problem `toy` and its candidates.


@dataclass(frozen=True)
class Kind:
    """A search on the toy problem."""

    changes: tuple[tuple[str, str], ...] = ()
    """Texts in problem.toml and what replaces them."""
    sources: tuple[str, ...] = (arx(2),)
    unsealed: bool = False
    validated: bool = True
    finished: bool = True


KINDS = {
    "several candidates, unsealed": Kind(sources=(arx(2), CRASH, arx(3)), unsealed=True),
    "not finished": Kind(finished=False, validated=False),
    "windows": Kind(
        (("[protocol]\n", '[protocol]\nkind = "windows"\nhorizon = 20\n'),), unsealed=True
    ),
    "guard": Kind((("[data]\n", '[data]\nguard = ["test.csv"]\n'), ('test = ["test.csv"]', ""))),
}


def run_of(kind: Kind, root: Path) -> Path:
    """Directory of a run of this kind."""
    problem = write_problem(root / "toy", experiments=1 + len(kind.sources))
    text = (problem / "problem.toml").read_text()
    for old, new in kind.changes:
        assert old in text
        text = text.replace(old, new)
    (problem / "problem.toml").write_text(text)
    agent = Scripted(kind.sources)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.search.run.can_read_records", lambda names: False)
        ready = prepare(load_problem(problem), agent.name, seed=0, runs=root / "runs")
        search(ready, agent, lambda event, view: None, lambda view: None)
    if not kind.finished:
        ledger = ready.directory / "ledger.jsonl"
        lines = ledger.read_bytes().splitlines(keepends=True)
        last = max(k for k, line in enumerate(lines) if b'"event":"evaluated"' in line)
        ledger.write_bytes(b"".join(lines[: last + 1]))
    return ready.directory


# The doors.


@dataclass
class Doors:
    """What the doors print of a run."""

    run: Any
    texts: dict[str, str] = field(default_factory=dict[str, str])
    objects: dict[str, Any] = field(default_factory=dict[str, Any])


def opened(directory: Path, kind: Kind) -> Doors:
    found = Doors(None)
    for command, *words in [
        *[("validate",)] * kind.validated,
        *[("unseal", "--yes"), ("unseal", "--json")] * kind.unsealed,
        *[("show",), ("show", "--json"), ("status",), ("status", "--json")],
    ]:
        done = command_line(command, directory, *words)
        assert done.code == 0, done.err
        if "--json" in words:
            found.objects[command] = json.loads(done.out.splitlines()[-1])
        else:
            found.texts[command] = done.out
    page = write_page(directory).read_text("utf-8")
    page = re.sub(r"<(style|script|svg)\b.*?</\1>", " ", page, flags=re.DOTALL)
    found.texts["page"] = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", page)).split())
    found.run = open_run(directory)
    return found


# Figures.

NUMBER = r"(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)"


@dataclass(frozen=True)
class Figure:
    """A figure that several doors print."""

    exact: Callable[[Doors], Any]
    """Its values by the ledger; None where the run has none."""
    texts: dict[str, str]
    """Door and pattern, whose groups are the printed values."""
    objects: dict[str, Callable[[Any], Any]]
    """Door and the values in its object."""


def _best(doors: Doors) -> Any:
    return doors.run.view.best


def _tested(doors: Doors) -> Any:
    record = doors.run.view.unsealed
    return None if record is None else record.ensemble.scores[0]


def _used(doors: Doors) -> Any:
    record, named = doors.run.view.unsealed, model_to_use(doors.run.view)
    return None if record is None else ledger.tested_model(record, named.model).scores[0].value


def _reference(doors: Doors) -> float | None:
    return doors.run.view.reference_value("linear model")


def _looks(doors: Doors) -> Any:
    looks = doors.run.view.looks
    return [s.outcome.value for s in looks[-1].scores] if looks else None


FIGURES = {
    "V": Figure(
        lambda doors: _best(doors).score.value,
        {
            "show": rf"V = {NUMBER} \(folds",
            "status": rf"(?s:.*)\| best #\d+ {NUMBER}",
            "page": rf"V, best candidate {NUMBER}",
        },
        {"show": lambda o: o["V"], "status": lambda o: o["best"]["V"]},
    ),
    "V of the folds": Figure(
        lambda doors: [fold.value for fold in _best(doors).score.folds],
        {"show": rf"\(folds {NUMBER}, {NUMBER}\)"},
        {"show": lambda o: o["folds"]},
    ),
    "V of the linear model": Figure(
        _reference,
        {
            "status": rf"\n +linear model +{NUMBER}",
            "page": rf"V, linear model {NUMBER}",
        },
        {"status": lambda o: o["references"]["linear model"]},
    ),
    "test error": Figure(
        lambda doors: _tested(doors) and _tested(doors).value,
        {"unseal": rf"output +ensemble.*\n +y +{NUMBER}"},
        {"unseal": lambda o: next(iter(o["test"].values()))},
    ),
    "test error of the model to use": Figure(
        lambda doors: _used(doors),
        {"page": rf"after the search, its \w+ is {NUMBER}"},
        {"unseal": lambda o: [v for k, v in o["use"].items() if k in ("rmse", "mae")]},
    ),
    "share of the test in the bands": Figure(
        lambda doors: _tested(doors) and [100.0 * c for c in doors.run.view.unsealed.bands.covered],
        {"unseal": rf"share inside .*\n +y +{NUMBER} %"},
        {"unseal": lambda o: [100.0 * c for c in o["bands"]["covered"].values()]},
    ),
    "error on the guard": Figure(
        _looks,
        {"status": rf"guard +#\d+ {NUMBER}, #\d+ {NUMBER}"},
        {},
    ),
}


def same(printed: str, exact: float) -> bool:
    """Whether a printed number is the exact one to its digits."""
    mantissa, _, power = printed.partition("e")
    digits = len(mantissa.partition(".")[2])
    unit = 10.0 ** (int(power or 0) - digits)
    return abs(float(printed) - exact) <= 0.5001 * unit + 1e-12 * abs(exact)


def as_list(value: Any) -> list[float]:
    return list(value) if isinstance(value, (list, tuple)) else [value]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Doors]:
    """What the doors print of a run of a kind."""
    known: dict[str, Doors] = {}

    def of(kind: str) -> Doors:
        if kind not in known:
            with unpainted():
                root = tmp_path_factory.mktemp("doors")
                known[kind] = opened(run_of(KINDS[kind], root), KINDS[kind])
        return known[kind]

    return of


@pytest.mark.parametrize("kind", KINDS)
def test_figures_are_the_same(kind: str, made: Callable[[str], Doors]) -> None:
    doors, wrong = made(kind), list[str]()
    for name, figure in FIGURES.items():
        value = figure.exact(doors)
        if value is None:
            continue
        exact = as_list(value)
        for door, pattern in figure.texts.items():
            match = re.search(pattern, doors.texts.get(door, ""))
            printed = () if match is None else match.groups()
            right = len(printed) == len(exact) and all(map(same, printed, exact))
            if door in doors.texts and not right:
                wrong.append(f"{name}: {door} prints {printed}, expected {exact}")
        for door, of in figure.objects.items():
            if door in doors.objects and as_list(of(doors.objects[door])) != exact:
                wrong.append(f"{name}: {door} --json has {of(doors.objects[door])}, not {exact}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("kind", KINDS)
def test_the_verdict_is_the_same(kind: str, made: Callable[[str], Doors]) -> None:
    doors = made(kind)
    judged = usability(doors.run.view)
    first, *others = judged.reasons or ("",)
    sentence = f"{judged.kind}: {first}" if first else judged.kind
    for door in ("show", "status"):
        found = doors.objects[door]["verdict"]
        assert found == {"kind": judged.kind, "reasons": list(judged.reasons)}, door
    for door in doors.texts.keys() & {"show", "status", "validate"}:
        lines = [line.split(None, 1) for line in doors.texts[door].splitlines()]
        assert ["verdict", sentence] in lines, door
    assert f"Verdict {judged.kind.capitalize()} " in doors.texts["page"]
    if judged.kind in ("doubtful", "not usable"):
        assert all(" ".join(one.split()) in doors.texts["page"] for one in judged.reasons)
    assert len(others) < len(judged.reasons) or not judged.reasons


# One refit of the library: its parameters, poles, gains and noise.


@dataclass(frozen=True)
class Refit:
    """A run of the estimator, and what doors print of its refit."""

    estimator: asia.SystemIdentifier
    shown: dict[str, Any]
    text: str
    linear: dict[str, Any]
    validated: str
    planned: dict[str, Any]
    controlled: str
    exported: dict[str, Any]
    page: str


@pytest.fixture(scope="module")
def refit(tmp_path_factory: pytest.TempPathFactory) -> Refit:
    root = tmp_path_factory.mktemp("refit")
    rng = np.random.default_rng(1)
    u, y = np.repeat(rng.normal(size=60), 4), np.zeros(240)
    for k in range(1, 240):
        y[k] = 0.8 * y[k - 1] + 0.4 * u[k - 1]
    y += 0.02 * rng.normal(size=240)
    found = asia.SystemIdentifier(1, runs=root, progress=False, budget={"retests": 0}).fit(
        u, y, sampling_time=0.5, inputs=["pump"], outputs=["level"]
    )
    directory = found.run_.directory

    def printed(*words: object) -> str:
        done = command_line(*words)
        assert done.code in (0, 1), done.err
        return done.out

    with unpainted():
        (exported,) = found.export("numpy", root / "export")
        linear = json.loads(printed("linear", directory, "--json"))
        validated = printed("validate", directory)
        planned = json.loads(printed("next", directory, "--duration", 30, "--json"))
        controlled = printed("control", directory)
        shown = json.loads(printed("show", directory, "--json"))
        text = printed("show", directory)
    page = write_page(directory).read_text("utf-8")
    page = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", page)).split())
    metadata = json.loads((exported.folder / "model.json").read_text())
    return Refit(found, shown, text, linear, validated, planned, controlled, metadata, page)


def test_parameters_have_one_value_and_one_interval(refit: Refit) -> None:
    frame: Any = refit.estimator.parameters_
    assert list(frame.index) == [one["name"] for one in refit.shown["parameters"]]
    assert len(frame)
    for one in refit.shown["parameters"]:
        row = frame.loc[one["name"]]
        ends = one["interval_95"] or (math.nan, math.nan)
        expected = [one["value"], one["standard_error"], *ends, one["standard_error_by_folds"]]
        values = row[["value", "standard_error", "low", "high", "fold_error"]].astype(float)
        assert np.array(expected, np.float64) == pytest.approx(values.to_numpy(), nan_ok=True)
        (line,) = [s for s in refit.text.splitlines() if s.startswith(f"  {one['name']}  ")]
        assert line.split(one["name"])[1].split()[0] == f"{one['value']:.5g}"
        for door in (refit.text, refit.page):
            interval = f"{ends[0]:.4g} to {ends[1]:.4g}".replace("-", "[-\N{MINUS SIGN}]")
            assert math.isnan(ends[0]) or re.search(interval, door), interval


def test_the_linear_model_is_that_of_the_refit(refit: Refit) -> None:
    (point,) = refit.linear["points"]
    parameters = {one["name"]: one["value"] for one in refit.shown["parameters"]}
    step, gain = point["sampling_time"], parameters["gain y1/u1"]
    times = [one["time_s"] for one in point["poles"] if one["time_s"] is not None]
    assert times[0] == pytest.approx(step * parameters["time constant 1 [samples]"], rel=1e-6)
    assert point["gain"][0][0] == pytest.approx(gain, rel=1e-6)
    assert refit.exported["sampling_time"] == step == refit.planned["sampling_time"]
    assert f"sampling time {step:g} s" in "\n".join(refit.linear["text"])
    pole = next(line for line in refit.linear["text"] if line.startswith("pole "))
    assert f"{point['poles'][0]['real']:.6g}" in pole
    assert f"time constant {times[0]:.4g} s" in pole
    assert " ".join(pole.split()) in refit.page
    # `asia validate` prints three digits of the gain, from small steps of the same model.
    (static,) = set(re.findall(rf"static gain {NUMBER} on level", refit.validated))
    assert same(static, gain)


def test_the_noise_is_the_same(refit: Refit) -> None:
    (noise,) = refit.planned["noise"]
    (printed,) = re.findall(rf"noise +level {NUMBER} moves", refit.controlled)
    assert same(printed, noise)
    (printed,) = re.findall(rf"\(level {NUMBER} is 1\)", "\n".join(refit.planned["text"]))
    assert same(printed, noise)
