"""Error after one more record: a proposed one against APRBS, multisine and distance weighting.

A system is recorded in small motion around its resting point. Four families are fitted to that,
with two folds each. A second record of equal length follows, with an input that is proposed or
drawn, all of equal energy and within the same limits. After a new fit the ensemble of the family of
least V simulates an independent record over the whole range; its error is that against the
noise-free truth, over the standard deviation there.

With --keep the output must stay in the middle part of its whole range: the table then also has
the share of systems in which the true output did.

    python benchmarks/control/next_experiment.py --seeds 900 901
    python benchmarks/control/next_experiment.py --seeds 900 901 --keep 0.6
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.control.experiment_design import InputLimits, Subject, design_experiment
from asia.data import Signal, Trajectory
from asia.judge.scoring.bands import HeldOutErrors, error_sizes, output_bands, region_of
from asia.models import linear, narx, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import LeastSquares

sys.path.insert(0, str(Path(__file__).parents[1] / "searches"))
from systems import KINDS, Array, Kind, Response

FIRST, NEXT, TEST, SETTLE, PAST = 200, 200, 1000, 300, 10
SMALL, LEVEL = 0.3, 0.99
LEVELS, BOUNDED = 15, 5.0
METHODS = ("proposed", "aprbs", "multisine", "idw")

FAMILIES: tuple[tuple[Any, Any, Any], ...] = (
    (linear, linear.Config(order=3, delay=None), LevenbergMarquardt(30)),
    (narx, narx.Config(na=2, nb=2, terms=10), LeastSquares()),
    (neural_ss, neural_ss.Config(order=2), LevenbergMarquardt(30)),
)


@dataclass(frozen=True)
class Plant:
    """A drawn system with its limits."""

    kind: Kind
    respond: Response
    low: Array
    high: Array
    rest: Array
    noise: Array

    def record(self, u: Array, rng: np.random.Generator) -> tuple[Trajectory, Array]:
        """Record from rest, with the past window before it, and its noise-free output."""
        settled = np.concatenate([np.tile(self.rest, (SETTLE, 1)), u])
        truth = self.respond(settled)[SETTLE - PAST :]
        y = truth + self.noise * rng.standard_normal(truth.shape)
        return Trajectory(settled[SETTLE - PAST :], y, self.kind.sampling_time), truth[PAST:]

    def whole_range(self, rng: np.random.Generator, samples: int) -> Array:
        """Half an input of the kind's own sort, half random levels of many holding times."""
        own = np.clip(self.kind.excite(rng, samples), self.low, self.high)[: samples // 2]
        rows: list[Array] = []
        while len(rows) < samples - len(own):
            level = rng.uniform(self.low, self.high)
            rows += [level] * int(np.exp(rng.uniform(0.5, 4.0)))
        return np.concatenate([own, np.array(rows)[: samples - len(own)]])


def make_plant(kind: Kind, seed: int) -> Plant:
    """Draw a system; noise 35 dB below the output over the whole range."""
    rng = np.random.default_rng([seed, *kind.name.encode()])
    respond, u = kind.draw(rng), kind.excite(rng, 5000)
    low, high = np.quantile(u, 0.01, axis=0), np.quantile(u, 0.99, axis=0)
    plant = Plant(kind, respond, low, high, 0.5 * (low + high), np.zeros(kind.ny))
    _, truth = plant.record(plant.whole_range(rng, TEST), rng)
    return Plant(kind, respond, low, high, 0.5 * (low + high), truth.std(axis=0) * 10 ** (-35 / 20))


@dataclass(frozen=True)
class Fitted:
    """Fold models of one family, their error and their held-out errors."""

    models: list[Any]
    value: float
    errors: list[HeldOutErrors]


def fit(plant: Plant, records: list[Trajectory]) -> list[Fitted]:
    """Fit all families with two folds that cut every record, the lowest V first."""
    nu, ny = records[0].u.shape[1], records[0].y.shape[1]
    names = [Signal(f"u{j}") for j in range(nu)], [Signal(f"y{i}") for i in range(ny)]
    context = Context(
        tuple(names[0]), tuple(names[1]), plant.kind.sampling_time, PAST, PAST, seed=1
    )
    halves = [(r[: len(r) // 2], r[len(r) // 2 :]) for r in records]
    scale = np.concatenate([r.y for r in records]).std(axis=0)
    found: list[Fitted] = []
    for family, config, method in FAMILIES:
        models: list[Any] = []
        errors: list[HeldOutErrors] = []
        for fold in range(2):
            train = [pair[1 - fold] for pair in halves]
            try:
                model = family.train(family.build(config, context), train, context, method)
                blocks = [
                    part.y[PAST:] - simulate(model, part.u, part.y)
                    for part in (pair[fold] for pair in halves)
                ]
            except (ValueError, FloatingPointError, np.linalg.LinAlgError):
                blocks, model = [np.full((1, ny), np.inf)], None
            models.append(model)
            errors.append(HeldOutErrors(tuple(blocks)))
        rms = [np.sqrt((np.concatenate(e.blocks) ** 2).mean(axis=0)) for e in errors]
        value = float(np.mean([(one / scale).mean() for one in rms]))
        found.append(Fitted(models, value if np.isfinite(value) else np.inf, errors))
    return sorted(found, key=lambda one: one.value)


def simulate(model: Any, u: Array, y: Array) -> Array:
    """Simulate one record (T, nu) behind its past window."""
    found = model.simulate(u[None, :PAST], y[None, :PAST], u[None, PAST:])[0]
    return np.asarray(found, np.float64)


def subject(plant: Plant, record: Trajectory, fitted: list[Fitted], keep: Array) -> Subject:
    """The models after the first record, as `asia next` compares them."""
    usable = [one for one in fitted if np.isfinite(one.value)]
    best = usable[0]
    models = [m for one in usable for m in one.models]
    members = tuple(k for k, one in enumerate(usable) for _ in one.models)
    values = {k: one.value for k, one in enumerate(usable)}
    past_y = np.tile(record.y[:PAST].mean(axis=0), (PAST, 1))
    past_u = np.tile(plant.rest, (PAST, 1))

    def predict(u: Array) -> Array:
        past = [np.tile(one, (len(u), 1, 1)) for one in (past_u, past_y)]
        return np.stack([np.asarray(m.simulate(*past, u), np.float64) for m in models])

    zero = np.zeros((2, 1, record.y.shape[1]))
    width = output_bands(error_sizes(best.errors), zero, LEVEL).upper
    region = region_of([(record.u, record.y)])

    def reach(u: Array, y: Array) -> Array:
        return width * np.maximum(region.distance(past_u, u, y), 1.0)[:, None]

    changes = np.concatenate([np.diff(e, axis=0) for fold in best.errors for e in fold.blocks])
    limits = InputLimits(plant.low, plant.high, np.full(len(plant.low), np.inf), plant.rest)
    return Subject(
        predict, members, values, changes.std(axis=0) / np.sqrt(2.0), limits, keep, reach
    )


def distance_weighted(
    plant: Plant, record: Trajectory, of: Subject, energy: float, hold: int
) -> Array:
    """Input whose regressors are farthest from those known (inverse distance weighting), a level
    at a time, on the mean of the fold models of the best family (Bemporad, Information Sciences
    626, 2023)."""
    nu = len(plant.low)
    scale = np.concatenate([record.u.std(axis=0), record.y.std(axis=0)])

    def regressors(u: Array, y: Array) -> Array:
        x = np.concatenate([u, y], axis=1) / scale
        return np.concatenate([x[1:], x[:-1]], axis=1)

    known = regressors(record.u, record.y)
    rng, u = np.random.default_rng(0), np.zeros((0, nu))
    half = np.sqrt(3.0 * energy) * 0.5 * (plant.high - plant.low)
    while len(u) < NEXT:
        drawn = 0.5 * (plant.low + plant.high) + half * rng.uniform(-1.0, 1.0, (LEVELS, nu))
        levels = np.clip(drawn, plant.low, plant.high)
        tried = np.concatenate(
            [np.tile(u, (LEVELS, 1, 1)), np.repeat(levels[:, None], hold, axis=1)], axis=1
        )
        y = of.predict(tried)[:2].mean(axis=0)
        gains: list[float] = []
        new: list[Array] = []
        for one, out in zip(tried, y, strict=True):
            whole = np.concatenate([record.u[PAST - 1 : PAST], one])
            after = regressors(whole, np.concatenate([record.y[PAST - 1 : PAST], out]))[-hold:]
            apart = ((after[:, None] - known[None]) ** 2).sum(axis=2)
            weight = (1.0 / np.maximum(apart, 1e-12)).sum(axis=1)
            gains.append(float((2.0 / np.pi * np.arctan(1.0 / weight)).mean()))
            new.append(after)
        best = int(np.argmax(gains))
        u, known = tried[best], np.concatenate([known, new[best]])
    return u[:NEXT]


def error(
    plant: Plant, fits: list[Fitted], records: list[Trajectory], test: Trajectory, truth: Array
) -> float:
    """Error on the test record, over the standard deviation of the truth, of the first ensemble
    that stays bounded on random levels, as a search chooses its model."""
    rng = np.random.default_rng(3)
    levels = np.repeat(rng.uniform(plant.low, plant.high, (100, len(plant.low))), 10, axis=0)
    y = np.concatenate([r.y for r in records])
    middle, half = 0.5 * (y.max(axis=0) + y.min(axis=0)), 0.5 * np.ptp(y, axis=0)
    for fitted in fits:
        stressed = [simulate(m, levels, np.tile(y[0], (PAST, 1))) for m in fitted.models]
        if (np.abs(np.array(stressed) - middle) <= BOUNDED * half).all():
            break
    else:
        fitted = fits[0]
    found = np.mean([simulate(model, test.u, test.y) for model in fitted.models], axis=0)
    return float(np.mean(np.sqrt(((found - truth) ** 2).mean(axis=0)) / truth.std(axis=0)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[700, 701])
    parser.add_argument("--keep", type=float, help="share of the output range that is permitted")
    options = parser.parse_args()
    columns = [
        *((f"true {m}" for m in METHODS) if options.keep else (f"error {m}" for m in METHODS))
    ]
    print(f"| system | error before | energy | {' | '.join(columns)} | s |")
    print("|---" * (len(columns) + 4) + "|")
    rows: list[list[float]] = []
    for name in options.kinds:
        for seed in options.seeds:
            plant = make_plant(KINDS[name], seed)
            rng = np.random.default_rng([seed, 1])
            u = plant.kind.excite(rng, FIRST)
            u = np.clip(plant.rest + SMALL * (u - u.mean(axis=0)), plant.low, plant.high)
            first, _ = plant.record(u, rng)
            test, truth = plant.record(plant.whole_range(rng, TEST), rng)
            middle, half = (
                0.5 * (truth.max(axis=0) + truth.min(axis=0)),
                0.5 * np.ptp(truth, axis=0),
            )
            share = options.keep or np.inf
            keep = np.stack([middle - share * half, middle + share * half])
            fitted = fit(plant, [first])
            start = time.monotonic()
            of = subject(plant, first, fitted, keep)
            found = design_experiment(of, NEXT, seed=seed)
            seconds = time.monotonic() - start
            idw = distance_weighted(plant, first, of, found.energy, max(int(found.rise / 2), 1))
            idw = of.limits.scaled(idw[None], found.energy, equal=True)[0]
            row: list[float] = []
            for u in (found.proposed.u, found.aprbs.u, found.multisine.u, idw):
                second, clean = plant.record(u, np.random.default_rng([seed, 2]))
                if options.keep:
                    over = np.maximum(clean - keep[1], keep[0] - clean) / half
                    row.append(float(over.max()))
                else:
                    again = fit(plant, [first, second])
                    row.append(error(plant, again, [first, second], test, truth))
            rows.append(row)
            before = error(plant, fitted, [first], test, truth)
            values = " | ".join(f"{value:.4f}" for value in row)
            mark = "" if found.proposed.excess == 0.0 else " (no input found)"
            print(
                f"| {name} {seed}{mark} | {before:.4f} | {found.energy:.2f} | {values} | "
                f"{seconds:.0f} |", flush=True,
            )  # fmt: skip
    table = np.array(rows)
    if options.keep:
        for name, column in zip(METHODS, table.T, strict=True):
            print(f"{name}: true output within its limits in {(column <= 0).mean():.0%}")
        return
    for name, column in zip(METHODS[1:], table[:, 1:].T, strict=True):
        ratio = table[:, 0] / column
        print(
            f"proposed over {name}: median {np.median(ratio):.3f}, geometric mean "
            f"{np.exp(np.log(ratio).mean()):.3f}, better in {(ratio < 1).mean():.0%}"
        )


if __name__ == "__main__":
    main()
