"""Fits to records with missing outputs, against fits to whole records.

    python benchmarks/data/masked.py [--seeds 0 1 2] [--share 0.3]
    python benchmarks/data/masked.py --seldom [--seeds 0 1 2]

Three systems: a third-order linear one, a tank with a square-root outflow, and two inputs on two
coupled outputs. A linear model of order 3 and a polynomial NARX model are fitted three times: to
four whole records, to records from which a share of the outputs was taken at random, and to records
that lost the same share in bursts of 5 to 40 samples. Two contiguous folds, past windows of 10. V
counts measured samples alone. A cell is V, median over the seeds; the ratio is the median over the
seeds of V over that of the whole records. `true` is the ratio of the errors of the same simulations
against the noise-free outputs.

With `--seldom` the second of the coupled outputs is measured at every tenth sample. Cells are V of
the first output and `true`, its error against the noise-free output in the same measure.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.interfaces.workspace.tools import evaluate
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, ProtocolRule

Array = NDArray[np.float64]

RECORDS, SAMPLES, NOISE, DT = 4, 400, 0.05, 0.1
LINEAR = """
from asia.models import linear
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = linear.build(linear.Config(order=3, delay=0), context)
    return linear.train(model, trajectories, context, LevenbergMarquardt(iterations=30))
"""
NARX = """
from asia.models import narx
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = narx.build(narx.Config(), context)
    return narx.train(model, trajectories, context, LevenbergMarquardt(iterations=30))
"""
FAMILIES = {"linear": LINEAR, "narx": NARX}


@dataclass(frozen=True)
class Measured:
    """Records, and their outputs without noise."""

    records: tuple[Trajectory, ...]
    truth: tuple[Array, ...]


def _steps(rng: np.random.Generator, channels: int) -> Array:
    hold = rng.integers(5, 25, size=SAMPLES)
    starts = np.minimum(np.cumsum(hold), SAMPLES)
    levels = rng.uniform(-1.0, 1.0, size=(SAMPLES, channels))
    return levels[np.searchsorted(starts, np.arange(SAMPLES), side="right") % SAMPLES]


def third_order(u: Array) -> Array:
    """A lag and a damped swing."""
    x, y = np.zeros(3), np.zeros((len(u), 1))
    a = np.array([[0.95, 0.08, 0.0], [-0.1, 0.93, 0.1], [0.0, 0.0, 0.85]])
    for k in range(len(u)):
        y[k] = x[0]
        x = a @ x + np.array([0.0, 0.0, 0.15]) * u[k, 0]
    return y


def tank(u: Array) -> Array:
    """Level under a square-root outflow."""
    x, y = 0.5, np.zeros((len(u), 1))
    for k in range(len(u)):
        y[k] = x
        x = max(x + 0.1 * (0.5 + 0.45 * u[k, 0] - 0.7 * np.sqrt(max(x, 0.0))), 0.0)
    return y


def coupled(u: Array) -> Array:
    """Two saturated inputs, each of which moves both outputs."""
    x, y = np.zeros(2), np.zeros((len(u), 2))
    for k in range(len(u)):
        y[k] = x
        v = np.tanh(1.5 * u[k])
        x = np.array(
            [0.9 * x[0] + 0.05 * x[1] + 0.1 * v[0], 0.92 * x[1] + 0.08 * v[1] - 0.03 * v[0]]
        )
    return y


SYSTEMS = {"third order": (third_order, 1), "tank": (tank, 1), "coupled": (coupled, 2)}


def measured(name: str, seed: int) -> Measured:
    """Records with white noise."""
    system, inputs = SYSTEMS[name]
    rng = np.random.default_rng([seed, inputs, len(name)])
    records: list[Trajectory] = []
    truths: list[Array] = []
    for k in range(RECORDS):
        u = _steps(rng, inputs)
        truth = system(u)
        y = truth + NOISE * truth.std(axis=0) * rng.normal(size=truth.shape)
        records.append(Trajectory(u, y, DT, f"record{k}"))
        truths.append(truth)
    return Measured(tuple(records), tuple(truths))


def at_random(y: Array, share: float, rng: np.random.Generator) -> Array:
    """Without a share of the values, each on its own."""
    return np.where(rng.random(y.shape) < share, np.nan, y)


def in_bursts(y: Array, share: float, rng: np.random.Generator) -> Array:
    """Without a share of the values, all outputs at once, 5 to 40 samples long."""
    lost = y.copy()
    while np.isnan(lost).mean() < share:
        first = int(rng.integers(1, len(y)))
        lost[first : first + int(rng.integers(5, 41))] = np.nan
    return lost


def seldom(y: Array) -> Array:
    """With the second output at a tenth of the rate."""
    lost = y.copy()
    lost[np.arange(len(y)) % 10 > 0, 1] = np.nan
    return lost


def fit(
    source: str, one: Measured, take: Callable[[Array], Array], output: int | slice = slice(None)
) -> tuple[float, float]:
    """V of one output or over all with what `take` leaves, and the same against the truth."""
    records = [Trajectory(r.u, take(r.y), DT, r.name) for r in one.records]
    rule = ProtocolRule(folds=FoldRule(count=2), past_inputs=10, past_outputs=10)
    inputs = tuple(Signal(f"u{k}") for k in range(records[0].u.shape[1]))
    outputs = tuple(Signal(f"y{k}") for k in range(records[0].y.shape[1]))
    context = Context(inputs, outputs, DT, 10, 10, seed=1)
    errors = list[list[float]]()
    for local in evaluate(source, make_folds(records, rule), context, rule, 300.0):
        blocks = local.fold.held_out
        truth = [one.truth[b.record][b.start : b.stop] for b in blocks]
        missed = [
            np.concatenate(local.y_hat) - np.concatenate(y) for y in ([b.y for b in blocks], truth)
        ]
        each = [np.sqrt(np.nanmean(e**2, axis=0)) / local.fold.scale for e in missed]
        errors.append([float(np.mean(e[output])) for e in each])
    value, true = np.mean(errors, axis=0).tolist()
    return value, true


def main() -> None:
    """Print the table."""
    options = _options()
    if options.seldom:
        print("| family | seed | whole | true | second output at a tenth | true |")
        print("|---|---|---|---|---|---|")
        for family, source in FAMILIES.items():
            rows = list[list[float]]()
            for seed in options.seeds:
                one = measured("coupled", seed)
                rows.append([*fit(source, one, lambda y: y, 0), *fit(source, one, seldom, 0)])
                print(f"| {family} | {seed} | {_cells(rows[-1])} |", flush=True)
            medians = np.median(rows, axis=0).tolist()
            print(f"| {family} | median | {_cells(medians)} |", flush=True)
        return
    print("| system | family | whole | at random | ratio | true | in bursts | ratio | true |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in SYSTEMS:
        for family, source in FAMILIES.items():
            print(_row(name, family, source, options.seeds, options.share), flush=True)


def _cells(values: Sequence[float]) -> str:
    return " | ".join(f"{v:.4f}" for v in values)


def _row(name: str, family: str, source: str, seeds: Sequence[int], share: float) -> str:
    whole: list[tuple[float, float]] = []
    lost: dict[str, list[tuple[float, float]]] = {"random": [], "bursts": []}
    for seed in seeds:
        one = measured(name, seed)
        whole.append(fit(source, one, lambda y: y))
        for how, take in (("random", at_random), ("bursts", in_bursts)):
            rng = np.random.default_rng([seed, 99])
            lost[how].append(fit(source, one, partial(take, share=share, rng=rng)))
        print(f"{name} {family} seed {seed}", file=sys.stderr, flush=True)
    cells = [name, family, f"{statistics.median(v for v, _ in whole):.4f}"]
    for found in lost.values():
        cells.append(f"{statistics.median(v for v, _ in found):.4f}")
        for k in range(2):
            ratios = [a[k] / b[k] for a, b in zip(found, whole, strict=True)]
            cells.append(f"{statistics.median(ratios):.3f}")
    return f"| {' | '.join(cells)} |"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--seldom", action="store_true", help="the second output at a tenth")
    return parser.parse_args()


if __name__ == "__main__":
    main()
