"""Is the verdict right on models of known quality: good, mediocre and useless ones, twenty each?

Random plants of one or two lags with a mild bend and noise, three contiguous folds. Candidates are
fixed, without a search: the truth, a fitted linear model, models with a wrong time constant, the
mean, a wrong sign, a fit of noise by random functions, and a model that grows outside its records.
Scores, bands, checks and the verdict are those of `asia run` and `asia validate`; the lines of the
ledger are made by this script.

    python benchmarks/validation/verdicts.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from asia.analysis.verdict import BOUNDED, Usability, usability
from asia.data import Array
from asia.data.segment import Segment
from asia.judge.scoring.bands import HeldOutErrors, calibrate, error_sizes
from asia.judge.scoring.checks.check import Check
from asia.judge.scoring.checks.errors import check_bands, check_overfit
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import check_gain
from asia.judge.scoring.checks.validation_data import SimulatedSegments, without_responses
from asia.judge.scoring.outcome import combine, score_fold
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.events import (
    Evaluated,
    Proposed,
    RecordedCheck,
    RefitCheck,
    Refitted,
    Started,
    Stopped,
    StressTest,
    Validated,
)
from asia.ledger.view import replay

SAMPLES, FOLDS = 1500, 3
Simulate = Callable[[Array], Array]
"""Outputs (T,) for inputs (T,), from rest."""
Fit = Callable[["Plant", Array, Array, np.random.Generator], Simulate]
"""A model fitted to the inputs and outputs (T,) of one fold's training samples, NaN held out."""


@dataclass(frozen=True)
class Plant:
    """Lags in series, then a bend."""

    poles: tuple[float, ...]
    gain: float
    bend: float

    def simulate(self, u: Array) -> Array:
        """Outputs without noise."""
        x = self.gain * u
        for pole in self.poles:
            x = np.asarray(lfilter([0.0, 1.0 - pole], [1.0, -pole], x))
        return x + self.bend * x**2


def truth(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
    """The plant itself."""
    del u, y, rng
    return plant.simulate


def fitted(columns: Callable[[Array], Array]) -> Fit:
    """Least squares on functions (T, n) of the inputs."""

    def fit(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
        del plant, rng
        known = ~np.isnan(y)
        gains = np.linalg.lstsq(columns(u)[known], y[known], rcond=None)[0]
        return lambda v: columns(v) @ gains

    return fit


def lags(u: Array) -> Array:
    """A constant and the input through lags of several time constants."""
    parts = [lfilter([0.0, 1.0 - p], [1.0, -p], u) for p in (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)]
    return np.stack([np.ones(len(u)), *parts], axis=1)


def noise_functions(u: Array) -> Array:
    """Random functions of the input's past: so many that they fit the noise."""
    rng = np.random.default_rng(1)
    past = np.stack([np.roll(u, k) for k in range(30)], axis=1)
    mixed = past @ rng.standard_normal((30, 900)) / 2.0
    return np.tanh(mixed + rng.standard_normal(900))


def slower(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
    """The plant with time constants of the double and a smaller gain."""
    del u, y, rng
    return Plant(tuple(p**0.5 for p in plant.poles), 0.8 * plant.gain, 0.0).simulate


def mean(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
    """The mean of the output."""
    del plant, u, rng
    return lambda v: np.full(len(v), np.nanmean(y))


def wrong_sign(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
    """The plant with the sign of its gain turned."""
    del u, y, rng
    return Plant(plant.poles, -plant.gain, plant.bend).simulate


def growing(plant: Plant, u: Array, y: Array, rng: np.random.Generator) -> Simulate:
    """The plant and a mode that grows beyond the length of the records."""
    del u, y, rng
    return lambda v: plant.simulate(v) + 1e-9 * np.exp(np.minimum(0.012 * np.arange(len(v)), 200.0))


# Quality, noise over signal, largest bend, candidates.
KINDS: dict[str, tuple[float, float, tuple[Fit, ...]]] = {
    "good": (0.15, 0.15, (truth, fitted(lags))),
    "mediocre": (0.8, 0.4, (slower, fitted(lags))),
    "useless": (0.3, 0.2, (mean, wrong_sign, fitted(noise_functions), growing)),
}


def judge(kind: str, number: int) -> Usability:
    """The verdict on one model."""
    noise, bend, candidates = KINDS[kind]
    rng = np.random.default_rng([59, list(KINDS).index(kind), number])
    poles = np.exp(-1.0 / rng.uniform(2.0, 15.0, int(rng.integers(1, 3))))
    plant = Plant(tuple(poles.tolist()), rng.uniform(0.5, 3.0), rng.uniform(0.0, bend))
    hold = int(rng.integers(3, 20))
    u = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // hold + 1), hold)[:SAMPLES]
    clean = plant.simulate(u)
    y = clean + noise * clean.std() * rng.standard_normal(SAMPLES)
    fit = candidates[number % len(candidates)]
    parts = np.array_split(np.arange(SAMPLES), FOLDS)
    models = [fit(plant, u, np.where(np.isin(np.arange(SAMPLES), p), np.nan, y), rng)
              for p in parts]  # fmt: skip
    answers = [model(u) for model in models]
    return usability(replay(events(u, y, parts, models, answers))) or Usability("not usable", ())


def events(
    u: Array, y: Array, parts: list[Array], models: list[Simulate], answers: list[Array]
) -> list[object]:
    """Lines of the ledger: one experiment, its refit, its stress simulation and validation."""
    scale = np.array([y.std()])
    scores, train, held, blocks, errors = [], [], [], [], []
    for part, y_hat in zip(parts, answers, strict=True):
        score = score_fold([y[part, None]], [y_hat[part, None]], scale, "rmse")
        rest = np.setdiff1d(np.arange(len(y)), part)
        train.append(float(np.sqrt(np.mean((y - y_hat)[rest] ** 2)) / scale[0]))
        held.append(score.value)
        figures = Diagnostics(train[-1], 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0)
        names = dict.fromkeys(("model", "y_hat", "curve"), "0" * 64)
        scores.append(replace(score, **names, diagnostics=figures, fit_seconds=1.0))
        inputs, outputs = u[:, None], y[:, None]
        held_out = Segment(inputs[:0], outputs[:0], inputs[part], outputs[part], start=int(part[0]))
        blocks.append(held_out.simulated(y_hat[part, None]))
        errors.append(HeldOutErrors(((y - y_hat)[part, None],)))
    together = np.stack(answers)
    apart = [np.std(a - (together.sum(axis=0) - a) / (FOLDS - 1)) for a in together]
    test = stress(u, y, models)
    checks = validation(SimulatedSegments(tuple(blocks), ("u",), ("y",), 1.0), errors, train, held)
    compared = RefitCheck(tuple(train), None, float(np.mean(apart) / scale[0]), (), None)
    recorded = tuple(
        RecordedCheck(c.name, c.verdict, c.sentence, str(c.cause or ""), c.weight) for c in checks
    )
    return [
        Started("made", "made", "expert", 0, 1, None, ("y",), "0" * 64, "1" * 64, None,
                "landlock", (), {}),
        Proposed(1, None, "explore", "linear", "t", "h", "e", "0" * 64, "1"),
        Evaluated(1, "keep", combine(scores), None, 1.0),
        Stopped("budget"),
        Refitted(1, None, "none", check=compared, use="ensemble", reason="", stress=(test,)),
        Validated(1, "ensemble", "", "", recorded, "0" * 64, 0, 0, 0),
    ]  # fmt: skip


def stress(u: Array, y: Array, models: list[Simulate]) -> StressTest:
    """The models on twice the record, as the stress simulation does it."""
    middle, half = (y.max() + y.min()) / 2.0, (y.max() - y.min()) / 2.0
    reach = max(float(np.abs((m(np.tile(u, 2)) - middle) / half).max()) for m in models)
    outcome = "bounded" if reach <= BOUNDED.level else "diverges"
    return StressTest("ensemble", 1, reach, "y", None, outcome)


def validation(
    found: SimulatedSegments, errors: list[HeldOutErrors], train: list[float], held: list[float]
) -> tuple[Check, ...]:
    """The checks that the verdict reads."""
    data, bands = without_responses(found), calibrate(errors, 0.9)
    worth = np.array(error_sizes(errors).independent)
    return (
        *residual_checks(data),
        check_gain(data),
        check_overfit(train, held, found),
        check_bands(bands.held.mean(axis=0), worth, found.outputs, 0.9, bands.withdrawn),
    )


def main() -> None:
    """Print a row for each quality."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=20)
    parser.add_argument("--show", action="store_true", help="print each verdict")
    options = parser.parse_args()
    print("| quality | usable | doubtful | not usable |")
    print("|---|---|---|---|")
    for kind in KINDS:
        found = [judge(kind, number) for number in range(options.each)]
        counts = Counter(one.kind for one in found)
        columns = [str(counts[name]) for name in ("usable", "doubtful", "not usable")]
        print(f"| {kind} | {' | '.join(columns)} |", flush=True)
        for one in found if options.show else ():
            print(f"    {one.kind}: {' '.join(one.reasons)}")


if __name__ == "__main__":
    main()
