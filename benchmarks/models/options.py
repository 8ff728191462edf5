"""Benefit and harm of each option of the library."""

from __future__ import annotations

import argparse
import ast
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from types import ModuleType
from typing import Any

import numpy as np
from option_systems import (
    ALIKE,
    LEVELS,
    UNLIKE,
    System,
    TankEffects,
    body,
    duffing,
    tanks,
    vehicle,
)

from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, Outcome, Score
from asia.models import greybox, neural_ss, physics_net, recurrent
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import Adam
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.load import load_problem

Draw = Callable[[int], System]
"""The system of a seed."""
REBUILT = Path(__file__).parents[1] / "rebuilt"
FEW = TankEffects(samples=60, noise=0.1)
LM = LevenbergMarquardt(iterations=40, starts=3)


@dataclass(frozen=True)
class Fit:
    """A family, its settings and its method."""

    family: ModuleType
    config: dict[str, Any]
    method: Any

    def with_config(self, **option: Any) -> Fit:
        """Change settings of the model."""
        return replace(self, config={**self.config, **option})

    def with_method(self, **option: Any) -> Fit:
        """Change settings of the method."""
        return replace(self, method=replace(self.method, **option))

    def error(self, system: System) -> float:
        """Relative simulation error on the fresh record, mean over the outputs."""
        known = system.context
        model = self.family.build(self.family.Config(**self.config), known)
        model = self.family.train(model, system.training, known, self.method)
        u, y, past = system.fresh.u, system.fresh.y, max(known.n_past_u, known.n_past_y)
        length = known.horizon or len(u) - past
        starts = np.arange(past, len(u) - length + 1, length)[:, None]
        rows = starts + np.arange(length)
        past_u = u[starts + np.arange(-known.n_past_u, 0)]
        past_y = y[starts + np.arange(-known.n_past_y, 0)]
        truth = system.truth[rows]
        square = (model.simulate(past_u, past_y, u[rows]) - truth) ** 2
        return float(np.mean(np.sqrt(square.mean(axis=(0, 1))) / truth.std(axis=(0, 1))))


@dataclass(frozen=True)
class Row:
    """An option, and systems with and without its effect."""

    option: str
    effect: str
    present: Draw
    absent: Draw
    without: Fit
    given: Fit


PLAIN = Fit(greybox, {}, LM)
SMALL = Fit(neural_ss, {"order": 2, "hidden": 6}, LevenbergMarquardt(iterations=40, starts=2))
CORRECTED = Fit(
    physics_net, {"network": "mlp", "hidden": 16}, Adam(steps=600, learning_rate=5e-3, batch=16)
)
GATED = Fit(
    recurrent,
    {"cell": "gru", "hidden": 8},
    Adam(steps=600, learning_rate=5e-3, truncation=64, batch=8),
)


def tank_row(name: str, effect: str, own: TankEffects, given: Fit) -> Row:
    """A row on the tanks with and without an effect."""
    return Row(name, effect, partial(tanks, own), partial(tanks, TankEffects()), PLAIN, given)


ROWS = (
    *(
        tank_row(
            f'sensor="{sensor}"',
            "level to the power 0.7",
            TankEffects(sensor=0.7),
            PLAIN.with_config(sensor=sensor),
        )
        for sensor in ("power", "spline")
    ),
    tank_row(
        "lag",
        "flow between the tanks late by 6 s",
        TankEffects(pipe=6.0),
        PLAIN.with_config(lag=("x1",)),
    ),
    tank_row(
        "smooth",
        "lower outlet up to 7 % from its law",
        TankEffects(bumps=0.07),
        PLAIN.with_config(smooth=("x2",), smooth_width=0.2),
    ),
    tank_row(
        "saturation",
        "upper tank over its rim at 4, softly",
        TankEffects(rim=4.0),
        PLAIN.with_config(saturation=("x1",)),
    ),
    tank_row(
        "noise_model",
        "slow disturbance, 20 % of the output, 40 s",
        TankEffects(drift=0.2),
        PLAIN.with_method(noise_model="slow"),
    ),
    Row(
        "priors of the problem file",
        "alike tanks, 60 samples, 10 % noise; absent: wrong priors",
        partial(tanks, FEW, physics=ALIKE),
        partial(tanks, FEW, physics=UNLIKE),
        PLAIN.with_config(prior_width=None),
        PLAIN,
    ),
    Row(
        'initial="estimated"',
        "both levels measured with 10 % noise, slow tanks",
        partial(tanks, TankEffects(noise=0.1, slowness=5.0), physics=LEVELS),
        partial(tanks, TankEffects(noise=0.001), physics=LEVELS),
        PLAIN.with_config(initial="measured"),
        PLAIN.with_config(initial="estimated"),
    ),
    Row(
        "neural_ss: symmetry",
        "odd plant; absent: an uneven one",
        duffing,
        partial(duffing, bias=0.4),
        SMALL,
        SMALL.with_config(symmetry=True),
    ),
    Row(
        "Adam: symmetry",
        "odd plant; absent: an uneven one",
        duffing,
        partial(duffing, bias=0.4),
        GATED,
        GATED.with_method(symmetry=True),
    ),
    Row(
        "Adam: symmetry, two rotors",
        "mirror image; absent: uneven rotors",
        vehicle,
        partial(vehicle, uneven=0.2),
        GATED,
        GATED.with_method(symmetry=True),
    ),
    Row(
        "physics_net: symmetry",
        "mirror image at corrections; absent: a torque to one side",
        body,
        partial(body, uneven=3.0),
        CORRECTED,
        CORRECTED.with_config(symmetry=True),
    ),
)


def main() -> None:
    """Print the table that is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", default="", metavar="WORD,WORD", help="rows with these words")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    candidates = parser.add_mutually_exclusive_group()
    candidates.add_argument("--tanks", action="store_true")
    candidates.add_argument("--nanodrone", action="store_true")
    asked = parser.parse_args()
    if asked.tanks or asked.nanodrone:
        left_out("cascaded_tanks" if asked.tanks else "nanodrone", asked.seeds)
        return
    words = asked.rows.split(",")
    print("| option | effect | error without | with | ratio | absent: without | with | ratio | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in ROWS:
        if any(word in row.option for word in words):
            print(line(row, asked.seeds), flush=True)


def line(row: Row, seeds: Sequence[int]) -> str:
    """The row of the table."""
    started = time.perf_counter()
    cells: list[str] = []
    for draw in (row.present, row.absent):
        pairs = [(row.without.error(draw(s)), row.given.error(draw(s))) for s in seeds]
        without, given = (median(side) for side in zip(*pairs, strict=True))
        ratio = median(b / a for a, b in pairs)
        cells += [f"{without:.2g}", f"{given:.2g}", f"{ratio:.2f}"]
    seconds = time.perf_counter() - started
    return f"| {row.option} | {row.effect} | {' | '.join(cells)} | {seconds:.0f} |"


def left_out(problem: str, seeds: Sequence[int]) -> None:
    """V of the rebuilt candidate of a problem, and without each of its settings."""
    source = (REBUILT / f"{problem}.py").read_text("utf-8")
    print("| left out | V, by seed | median | times the whole | s |\n|---|---|---|---|---|")
    whole = None
    for name, text in [("nothing", source), *without_each_setting(source)]:
        started = time.perf_counter()
        outcomes = [evaluated(problem, text, seed) for seed in seeds]
        values = [outcome.value for outcome in outcomes if isinstance(outcome, Score)]
        failed = [outcome.reason for outcome in outcomes if isinstance(outcome, Failure)]
        seconds = time.perf_counter() - started
        each = ", ".join([*(f"{v:.4f}" for v in values), *failed])
        # A setting may need another one: without that the candidate fails.
        middle = median(values) if values else float("nan")
        whole = whole or middle
        print(f"| {name} | {each} | {middle:.4f} | {middle / whole:.3f} | {seconds:.0f} |")
        sys.stdout.flush()


def without_each_setting(source: str) -> list[tuple[str, str]]:
    """The candidate without each keyword of its families' settings and its methods in turn, where
    that keyword names an option and not a size."""
    found: list[tuple[str, str]] = []
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    for call, keyword in ((c, k) for c in calls for k in c.keywords):
        name = ast.unparse(call.func)
        if keyword.arg in SIZES or not (name.endswith("Config") or name in METHODS):
            continue
        text = without(source, keyword)
        found.append((f"{name.removesuffix('.Config')} {keyword.arg}", text))
    if "greybox.Config(" in source:
        text = source.replace("greybox.Config(", "greybox.Config(prior_width=None,", 1)
        found.append(("priors of the problem", text))
    return found


METHODS = ("LevenbergMarquardt", "Adam", "LBFGS", "MultipleShooting")
SIZES = (
    "iterations", "starts", "damping", "tolerance", "steps", "learning_rate", "weight_decay",
    "batch", "truncation", "loss", "hidden", "layers", "network", "substeps", "members",
    "equations", "sparsity",
)  # fmt: skip
"""Settings that are no options."""


def without(source: str, keyword: ast.keyword) -> str:
    """The source with the keyword and the comma after it cut out."""
    lines = source.splitlines(keepends=True)
    ends = [0]
    for text in lines:
        ends.append(ends[-1] + len(text.encode()))
    assert keyword.end_lineno is not None
    assert keyword.end_col_offset is not None
    first = ends[keyword.lineno - 1] + keyword.col_offset
    last = ends[keyword.end_lineno - 1] + keyword.end_col_offset
    data = source.encode()
    rest = data[last:].lstrip()
    rest = rest.removeprefix(b",") if rest.startswith(b",") else data[last:]
    return (data[:first] + rest).decode()


def evaluated(name: str, source: str, seed: int) -> Outcome:
    """V of a candidate on the training data, or why it has none."""
    problem = load_problem(name)
    rule = problem.protocol
    known = search_context(problem, seed)
    budget = Budget(fit_seconds=3600.0, memory_mb=problem.budget.memory_mb)
    folds = make_folds(problem.train, rule)
    data = EvaluationData(folds, problem.train, known, rule)
    judge = Evaluator(data, WorkerRunner(Isolation.PROCESS, budget, LocalExecutor(2)))
    return judge.evaluate(source).outcome


if __name__ == "__main__":
    main()
