"""How often do 95 % intervals of parameters cover the truth? Small fits of grey-boxes to systems
whose parameters are known, under white and under coloured noise.

    python benchmarks/searches/intervals.py [--fits 200] [--seed 0]

Each fit has a system of its own numbers, another input and other noise. Intervals are those of
`asia show`: the sandwich covariance with an autoregressive model of the residuals. Prints a row for
each system and noise, and all of them together. A minute on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.problem import Bounds, ParameterRange, Physics

Array = NDArray[np.float64]
Rate = Callable[[Array, float, dict[str, float]], list[float]]

SAMPLES, RECORDS, NOISE = 250, 2, 0.05
METHOD = LevenbergMarquardt(iterations=40, starts=4)
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


def records(kind: Kind, truth: dict[str, float], rho: float, rng: np.random.Generator):
    """Records of the system with noise of 5 % of the output's standard deviation."""
    found: list[Trajectory] = []
    for _ in range(RECORDS):
        levels = rng.uniform(kind.low, kind.high, size=SAMPLES // 8 + 1)
        u = np.repeat(levels, 8)[:SAMPLES]
        states = [np.array(kind.start)]
        for value in u[:-1]:
            step = solve_ivp(
                lambda _, x, v=value: kind.rate(x, float(v), truth),
                (0.0, kind.sampling_time), states[-1], rtol=1e-8, atol=1e-10,
            )  # fmt: skip
            states.append(step.y[:, -1])
        y = np.array(states)[:, [list(kind.physics.states).index(kind.physics.observation["y"])]]
        white = rng.normal(size=SAMPLES + 300)
        coloured = np.sqrt(1 - rho**2) * lfilter([1.0], [1.0, -rho], white)[300:, None]
        found.append(Trajectory(u[:, None], y + NOISE * y.std() * coloured, kind.sampling_time, ""))
    return found


def covered(kind: Kind, rho: float, seed: tuple[int, ...]) -> list[bool]:
    """For each parameter of one fit whether its interval holds the truth."""
    rng = np.random.default_rng(seed)
    truth = {n: v * float(np.exp(rng.normal(scale=0.2))) for n, v in kind.usual.items()}
    data = records(kind, truth, rho, rng)
    context = Context(
        (Signal("u"),), (Signal("y"),), kind.sampling_time, 5, 5, physics=kind.physics, seed=seed[0]
    )
    model = greybox.train(greybox.build(greybox.Config(), context), data, context, METHOD)
    found = model.estimates(data, context)
    return [one.low <= truth[one.name] <= one.high for one in found.parameters]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    cells = [(kind, colour) for kind in KINDS for colour in COLOURS]
    results: dict[tuple[str, str], list[bool]] = {}
    for number in range(wanted.fits):
        kind, colour = cells[number % len(cells)]
        held = covered(kind, COLOURS[colour], (wanted.seed, number))
        results.setdefault((kind.name, colour), []).extend(held)
    print("| system | noise | intervals | cover the truth |\n|---|---|---|---|")
    for (name, colour), held in results.items():
        print(f"| {name} | {colour} | {len(held)} | {100 * np.mean(held):.1f} % |")
    every = [one for held in results.values() for one in held]
    print(f"| all | all | {len(every)} | {100 * np.mean(every):.1f} % |")
    for colour in COLOURS:
        some = [one for (_, c), held in results.items() if c == colour for one in held]
        print(f"| all | {colour} | {len(some)} | {100 * np.mean(some):.1f} % |")


if __name__ == "__main__":
    main()
