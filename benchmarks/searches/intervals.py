"""How often do 95 % intervals of parameters hold the truth? Small fits of grey-boxes to systems
whose parameters are known: sound ones, ones with a parameter that drifts, and ones with an effect
that the equations lack; under white and under coloured noise, with 2, 3 and 5 folds.

    python benchmarks/searches/intervals.py [--fits 108] [--seed 0] [--jobs 1]

Each fit has a system of its own numbers, another input and other noise. Intervals are those of
`asia show`, the wider one of noise (sandwich covariance with an autoregressive model of the
residuals), fold models, and missing effect. The truth of a drifting parameter is its mean over the
records. Where an effect is missing it is the number that the simulating system has, which is what
a user would compare with a data sheet, and not the value that fits best without the effect.
36 fits take one to five minutes on one core.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.ledger.evidence import (
    FOLD_QUANTILE,
    IdentifiedParameter,
    estimated,
    interval_ends,
    with_fold_values,
)
from asia.models import greybox
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Bounds, ParameterRange, Physics

Array = NDArray[np.float64]
Rate = Callable[[Array, float, dict[str, float]], list[float]]

SAMPLES, RECORDS, NOISE = 250, 2, 0.05
METHOD = LevenbergMarquardt(iterations=40, starts=4)
CONDITIONS, FOLDS = ("sound", "drift", "missing effect"), (2, 3, 5)
COLOURS = {"white": 0.0, "AR(1) 0.7": 0.7, "AR(1) 0.95": 0.95}


@dataclass(frozen=True)
class Kind:
    """A system whose parameters are drawn around `usual`."""

    name: str
    physics: Physics
    rate: Rate
    usual: dict[str, float]
    sampling_time: float
    low: float
    high: float
    start: tuple[float, ...]


def _ranges(usual: dict[str, float]) -> dict[str, ParameterRange]:
    return {name: ParameterRange(value / 10, value * 10) for name, value in usual.items()}


def _kind(
    name: str, dynamics: dict[str, str], output: str, rate: Rate, usual: dict[str, float],
    sampling_time: float, low: float, high: float, start: tuple[float, ...], bounded: bool = False,
) -> Kind:  # fmt: skip
    physics = Physics(
        states=tuple(dynamics),
        parameters=_ranges(usual),
        dynamics=dynamics,
        observation={"y": output},
        bounds={state: Bounds(min=0.0) for state in dynamics} if bounded else {},
    )
    return Kind(name, physics, rate, usual, sampling_time, low, high, start)


KINDS = (
    _kind(
        "first-order lag", {"x": "-a*x + b*u"}, "x",
        lambda x, u, p: [-p["a"] * x[0] + p["b"] * u],
        {"a": 0.3, "b": 0.7}, 0.5, -1.0, 1.0, (0.3,),
    ),
    _kind(
        "Duffing", {"x": "v", "v": "-c*v - k*x - a*x**3 + b*u"}, "x",
        lambda x, u, p: [x[1], -p["c"] * x[1] - p["k"] * x[0] - p["a"] * x[0] ** 3 + p["b"] * u],
        {"c": 0.6, "k": 4.0, "a": 1.5, "b": 2.0}, 0.15, -3.0, 3.0, (0.2, -0.1),
    ),
    _kind(
        "two tanks",
        {"x1": "-k1*sqrt(x1) + k3*u", "x2": "k1*sqrt(x1) - k2*sqrt(x2)"}, "x2",
        lambda x, u, p: [
            -p["k1"] * np.sqrt(max(x[0], 0)) + p["k3"] * u,
            p["k1"] * np.sqrt(max(x[0], 0)) - p["k2"] * np.sqrt(max(x[1], 0)),
        ],
        {"k1": 0.3, "k2": 0.25, "k3": 0.2}, 1.0, 0.5, 3.0, (2.0, 2.0), bounded=True,
    ),
    _kind(
        "pendulum", {"x": "v", "v": "-g*sin(x) - d*v + b*u"}, "x",
        lambda x, u, p: [x[1], -p["g"] * np.sin(x[0]) - p["d"] * x[1] + p["b"] * u],
        {"g": 3.0, "d": 0.4, "b": 1.0}, 0.2, -1.0, 1.0, (0.5, 0.0),
    ),
)  # fmt: skip


def excitation(kind: Kind, rng: np.random.Generator) -> Array:
    """Levels held for eight samples (SAMPLES,); in every second record their size changes."""
    levels = rng.uniform(kind.low, kind.high, size=SAMPLES // 8 + 1)
    if rng.random() < 0.5:
        middle = 0.5 * (kind.low + kind.high)
        sizes = np.repeat(rng.uniform(0.3, 1.0, size=4), len(levels) // 4 + 1)[: len(levels)]
        levels = middle + sizes * (levels - middle)
    return np.repeat(levels, 8)[:SAMPLES]


def drift(rng: np.random.Generator) -> Array:
    """Factors (RECORDS, SAMPLES) of a parameter that ramps, jumps or swings by 15 to 50 %."""
    x = np.linspace(0.0, 1.0, RECORDS * SAMPLES)
    if rng.random() < 0.5:  # anew in each record: it warms up, say
        x = np.tile(np.linspace(0.0, 1.0, SAMPLES), RECORDS)
    form = rng.integers(3)
    if form == 0:
        shape = x
    elif form == 1:
        shape = (x > rng.uniform(0.25, 0.75)).astype(float)
    else:
        shape = 0.5 + 0.5 * np.sin(2 * np.pi * (x * rng.uniform(0.5, 1.5) + rng.random()))
    size = rng.uniform(0.15, 0.5) * rng.choice([-1.0, 1.0])
    return (1.0 + size * shape).reshape(RECORDS, SAMPLES)


@dataclass(frozen=True)
class Effect:
    """An effect of the system that the equations lack."""

    friction: float = 0.0
    """Coulomb friction, or a leak of the tank, over the largest force."""
    saturation: float = 0.0
    """Loss of input at its largest value."""
    lag: float = 0.0
    """Time constant of the actuator, in samples."""

    @staticmethod
    def drawn(rng: np.random.Generator) -> Effect:
        """One of the three."""
        name = rng.choice(["friction", "saturation", "lag"])
        low, high = {"friction": (0.04, 0.15), "saturation": (0.1, 0.3), "lag": (0.5, 2.0)}[name]
        return Effect(**{str(name): rng.uniform(low, high)})

    def input(self, u: Array, kind: Kind) -> Array:
        """Input of the equations (T,)."""
        if self.saturation:
            middle, size = 0.5 * (kind.low + kind.high), 0.5 * (kind.high - kind.low)
            bent = (u - middle) / size
            u = middle + size * bent * (1.0 - self.saturation * bent**2)
        if self.lag:
            pole = np.exp(-1.0 / self.lag)
            u = np.asarray(lfilter([1.0 - pole], [1.0, -pole], u, zi=[pole * u[0]])[0])
        return u

    def resist(self, kind: Kind, x: Array, rate: list[float], truth: dict[str, float]) -> Array:
        """The rate of the states with friction, or with a leak of the first tank."""
        found = np.array(rate)
        if self.friction and kind.name == "two tanks":
            found[0] -= self.friction * truth["k1"] * max(x[0], 0.0)
        elif self.friction:
            found[-1] -= self.friction * truth["b"] * kind.high * np.tanh(x[-1] / 0.05)
        return found


def records(kind: Kind, truth: dict[str, float], rho: float, rng: np.random.Generator,
            condition: str = "sound"):  # fmt: skip
    """Records of the system with noise of 5 % of the output's standard deviation, and the mean of
    each parameter over them."""
    found: list[Trajectory] = []
    moving, factors = "", np.ones((RECORDS, SAMPLES))
    effect = Effect.drawn(rng) if condition == "missing effect" else Effect()
    if condition == "drift":
        moving, factors = str(rng.choice(list(truth))), drift(rng)
    for number in range(RECORDS):
        u = excitation(kind, rng)
        states = [np.array(kind.start)]
        for value, factor in zip(effect.input(u, kind)[:-1], factors[number], strict=False):
            now = {n: v * factor if n == moving else v for n, v in truth.items()}
            step = solve_ivp(
                lambda _, x, v=value, p=now: effect.resist(kind, x, kind.rate(x, float(v), p), p),
                (0.0, kind.sampling_time), states[-1], rtol=1e-6, atol=1e-8,
            )  # fmt: skip
            states.append(step.y[:, -1])
        y = np.array(states)[:, [list(kind.physics.states).index(kind.physics.observation["y"])]]
        white = rng.normal(size=SAMPLES + 300)
        coloured = np.sqrt(1 - rho**2) * np.asarray(lfilter([1.0], [1.0, -rho], white))[300:, None]
        found.append(Trajectory(u[:, None], y + NOISE * y.std() * coloured, kind.sampling_time, ""))
    mean = {n: v * float(factors.mean()) if n == moving else v for n, v in truth.items()}
    return found, mean


def fold_records(data: list[Trajectory], count: int, fold: int) -> list[Trajectory]:
    """Return the training records of one of `count` contiguous folds."""
    kept: list[Trajectory] = []
    for one in data:
        edges = np.linspace(0, len(one), count + 1).round().astype(int)
        for first, last in ((0, edges[fold]), (edges[fold + 1], len(one))):
            if last > first:
                kept.append(Trajectory(one.u[first:last], one.y[first:last], one.sampling_time, ""))
    return kept


@dataclass(frozen=True)
class Fit:
    """A refit with the models of its folds."""

    truth: dict[str, float]
    """The mean of each parameter over the records."""
    parameters: tuple[IdentifiedParameter, ...]
    """As a search would print them."""


def fitted(kind: Kind, condition: str, rho: float, folds: int, seed: tuple[int, ...]) -> Fit:
    """One system, fitted to all of its records and to those of each fold."""
    rng = np.random.default_rng(seed)
    truth = {n: v * float(np.exp(rng.normal(scale=0.2))) for n, v in kind.usual.items()}
    data, mean = records(kind, truth, rho, rng, condition)
    context = Context(
        (Signal("u"),), (Signal("y"),), kind.sampling_time, 5, 5, physics=kind.physics, seed=seed[0]
    )

    def train(some: list[Trajectory]) -> greybox.GreyBox:
        return greybox.train(greybox.build(greybox.Config(), context), some, context, METHOD)

    found = train(data).estimates(data, context)
    tables = [train(fold_records(data, folds, k)).parameters() for k in range(folds)]
    return Fit(mean, with_fold_values(estimated(found), tables))


WAYS = ("noise alone", "folds alone", "quoted")


def holds(fit: Fit) -> list[dict[str, tuple[bool, float]]]:
    """For each parameter and way whether its interval holds the mean over the record, and its
    width over that of the interval by noise."""
    found: list[dict[str, tuple[bool, float]]] = []
    for one in fit.parameters:
        fitted, truth = one.fitted, fit.truth[one.fitted.name]
        low, high = fitted.low, fitted.high
        low, high = (-np.inf if low is None else low), (np.inf if high is None else high)
        alone = FOLD_QUANTILE * (one.fold_error or 0.0)
        ends = {
            "noise alone": (low, high),
            "folds alone": interval_ends(fitted.value, np.inf, -np.inf, fitted.lower, alone),
            "quoted": one.interval or (-np.inf, np.inf),
        }
        unit = high - low if np.isfinite(high - low) and high > low else 1.0
        found.append({way: (a <= truth <= b, (b - a) / unit) for way, (a, b) in ends.items()})
    return found


def run(number: int, seed: int) -> tuple[str, str, str, int, Fit]:
    """One fit of the design: conditions, then systems, numbers of folds, and noises."""
    condition = CONDITIONS[number % 3]
    kind = KINDS[number // 3 % len(KINDS)]
    folds = FOLDS[number // 12 % len(FOLDS)]
    colour = list(COLOURS)[number // 36 % len(COLOURS)]
    fit = fitted(kind, condition, COLOURS[colour], folds, (seed, number))
    return condition, kind.name, colour, folds, fit


def rows(results: list[tuple[str, str, str, int, Fit]]) -> Iterator[str]:
    """The table: each condition by number of folds, and all of it."""
    yield (
        "| condition | folds | systems | intervals | "
        + " | ".join(WAYS)
        + (
            " | quoted, median width over noise alone | decided by folds, by a missing effect "
            "| folds disagree |"
        )
    )
    yield "|---" * (4 + len(WAYS) + 3) + "|"
    for condition in CONDITIONS:
        for folds in (*FOLDS, 0):
            some = [r[4] for r in results if r[0] == condition and folds in (0, r[3])]
            held = [one for fit in some for one in holds(fit)]
            if not held:
                continue
            shares = " | ".join(f"{100 * np.mean([o[w][0] for o in held]):.1f} %" for w in WAYS)
            width = float(np.median([one["quoted"][1] for one in held]))
            every = [one for fit in some for one in fit.parameters]
            ways = [sum(o.decided_by == w for o in every) for w in ("folds", "missing effect")]
            apart = sum(one.disagrees for one in every)
            yield (
                f"| {condition} | {folds or 'all'} | {len(some)} | {len(held)} | {shares} "
                f"| {width:.1f} | {ways[0]}, {ways[1]} | {apart} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=108)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    wanted = parser.parse_args()
    with get_context("spawn").Pool(wanted.jobs) as pool:
        results = pool.starmap(run, [(n, wanted.seed) for n in range(wanted.fits)], chunksize=1)
    print("\n".join(rows(results)))


if __name__ == "__main__":
    main()
