"""Do the bands of `asia linear` hold the truth? Six nonlinear systems at three operating points.

Three systems are searched with their equations, three without. Each search has a few experiments
and two folds; `asia linear` linearises the model to use. With --direct there is no search:
`greybox` is fitted where there are equations, and `nl_lfr` elsewhere. The truth is the
zero-order-hold equivalent of the system's own linearisation.

    python benchmarks/models/linear_models.py [--experiments 6 | --direct] [--seeds 1] [--runs DIR]
        [--systems tanks,...]
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import approx_fprime, fsolve

import asia
from asia.export.linear import LinearPoint
from asia.judge.evaluation.fold_fits import search_context
from asia.lowering.evaluation import evaluate
from asia.lowering.linear import OperatingPoint, joined, linearised, operating_points
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered
from asia.models import greybox, nl_lfr
from asia.models.methods import LevenbergMarquardt
from asia.problem.load import load_problem
from asia.problem.problem import Problem

SAMPLES, NOISE = 1600, 0.02


@dataclass(frozen=True)
class System:
    """x' = rate(x, u), y = output(x)."""

    rate: Callable[[np.ndarray, float], list[float]]
    output: Callable[[np.ndarray], float]
    states: int
    step: float
    low: float
    high: float
    points: tuple[float, float, float]
    physics: dict[str, Any] | None = None


def equations(
    dynamics: dict[str, str], parameters: dict[str, float], **more: Any
) -> dict[str, Any]:
    ranges = {name: {"min": value / 10, "max": value * 10} for name, value in parameters.items()}
    return {"states": list(dynamics), "dynamics": dynamics, "parameters": ranges, **more}


SYSTEMS = {
    "tanks": System(
        lambda x, u: [-0.3 * math.sqrt(max(x[0], 0)) + 0.2 * u,
                      0.3 * math.sqrt(max(x[0], 0)) - 0.25 * math.sqrt(max(x[1], 0))],
        lambda x: x[1], 2, 1.0, 0.5, 3.0, (1.0, 1.75, 2.5),
        equations({"x1": "-k1*sqrt(x1) + k3*u", "x2": "k1*sqrt(x1) - k2*sqrt(x2)"},
                  {"k1": 0.3, "k2": 0.25, "k3": 0.2}, observation={"y": "x2"},
                  bounds={"x1": {"min": 0.0}, "x2": {"min": 0.0}}),
    ),
    "duffing": System(
        lambda x, u: [x[1], -0.6 * x[1] - 4.0 * x[0] - 1.5 * x[0] ** 3 + 2.0 * u],
        lambda x: x[0], 2, 0.15, -3.0, 3.0, (0.0, 1.0, 2.0),
        equations({"x": "v", "v": "-c*v - k*x - a*x**3 + b*u"},
                  {"c": 0.6, "k": 4.0, "a": 1.5, "b": 2.0}, observation={"y": "x"}),
    ),
    "pendulum": System(
        lambda x, u: [x[1], -3.0 * math.sin(x[0]) - 0.8 * x[1] + u],
        lambda x: x[0], 2, 0.2, -2.0, 2.0, (-1.5, 0.0, 1.0),
        equations({"x": "v", "v": "-g*sin(x) - d*v + b*u"}, {"g": 3.0, "d": 0.8, "b": 1.0},
                  observation={"y": "x"}),
    ),
    "exchanger": System(
        lambda x, u: [-(0.1 + 0.15 * u) * x[0] + 0.4 * u], lambda x: x[0], 1, 1.0, 0.2, 2.0,
        (0.5, 1.0, 1.6),
    ),
    "hammerstein": System(
        lambda x, u: [x[1], -0.25 * x[0] - 0.35 * x[1] + 0.25 * math.tanh(1.2 * u)],
        lambda x: x[0], 2, 0.5, -2.0, 2.0, (-1.0, 0.0, 0.7),
    ),
    "wiener": System(
        lambda x, u: [(u - x[0]) / 5.0, (x[0] - x[1]) / 2.0],
        lambda x: x[1] + 0.25 * x[1] ** 2 + 0.1 * x[1] ** 3, 2, 0.5, -2.0, 2.0, (-1.0, 0.0, 1.0),
    ),
}  # fmt: skip


def simulated(system: System, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    levels = rng.uniform(system.low, system.high, SAMPLES // 10 + 1)
    u = np.repeat(levels, 10)[:SAMPLES]
    x, y = rest(system, u[0]), np.empty(SAMPLES)
    for k in range(SAMPLES):
        y[k] = system.output(x)
        x = solve_ivp(lambda _, x, v=u[k]: system.rate(x, v), (0.0, system.step), x,
                      rtol=1e-8, atol=1e-10).y[:, -1]  # fmt: skip
    return u[:, None], (y + NOISE * y.std() * rng.normal(size=SAMPLES))[:, None]


def rest(system: System, u: float) -> np.ndarray:
    return np.asarray(fsolve(lambda x: system.rate(x, u), np.full(system.states, 0.5), xtol=1e-13))


def truth(system: System, u: float) -> tuple[float, np.ndarray]:
    """Static gain, and poles with an imaginary part of 0 or more, in discrete time."""
    x = rest(system, u)
    n = system.states
    slopes = [approx_fprime(np.append(x, u), lambda v, i=i: system.rate(v[:n], v[n])[i], 1e-7)
              for i in range(n)]  # fmt: skip
    a, b = np.array(slopes)[:, :n], np.array(slopes)[:, n]
    c = approx_fprime(x, system.output, 1e-7)
    poles = np.linalg.eigvals(expm(a * system.step))
    return float(-c @ np.linalg.solve(a, b)), poles[poles.imag >= -1e-9]


def judged(
    point: LinearPoint, gain: float, poles: np.ndarray, step: float
) -> list[tuple[str, Any]]:
    """Each quantity with whether its band holds the truth, None without a band."""
    band = point.gain_band
    found: list[tuple[str, Any]] = [
        ("gain", None if band is None else bool(band[0][0, 0] <= gain <= band[1][0, 0]))
    ]
    modes, bands = point.model.modes(), point.mode_bands
    for pole in poles:
        if not modes:
            found.append(("pole", False))
            continue
        k = int(np.argmin([abs(one[0] - pole) for one in modes]))
        s = np.log(pole) / step
        ends = bands[k]
        inside = None
        if ends is not None:
            values = np.array([abs(s) / (2 * math.pi), -s.real / abs(s)])
            inside = bool((ends[0] - 1e-9 <= values).all() and (values <= ends[1] + 1e-9).all())
        found.append(("pole", inside))
    return found


def fitted(problem: Problem, points: tuple[float, ...], seed: int) -> list[LinearPoint]:
    """Linear models of a model of the whole record and of models of both folds."""
    jax.config.update("jax_enable_x64", True)
    family, context = (greybox if problem.physics else nl_lfr), search_context(problem, seed)
    (record,), nu, ny = problem.train, 1, 1
    half = len(record) // 2
    parts = [record, record[half:], record[:half]]
    past = context.n_past_u, context.n_past_y
    models: list[LoweredModel] = []
    for part in parts:
        model = family.build(family.Config(), context)
        model = family.train(model, [part], context, LevenbergMarquardt(60, starts=4))
        models.append(lowered(model, *past, nu, ny))
    found: list[LinearPoint] = []
    for u in points:
        at: list[OperatingPoint] = []
        for one in models:
            states = [
                joined(evaluate(one.initial, [record.u[k : k + one.n_past_u],
                                              record.y[k : k + one.n_past_y], record.u[k]]))
                for k in (0, half)
            ]  # fmt: skip
            at.append(operating_points(one, states, np.array([u]))[0])
        own, *folds = [
            linearised(one, there, problem.sampling_time)
            for one, there in zip(models, at, strict=True)
        ]
        found.append(LinearPoint(f"u={u}", at[0], True, own, tuple(folds)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--experiments", type=int, default=6)
    parser.add_argument("--direct", action="store_true")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=Path(tempfile.mkdtemp()))
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    given = parser.parse_args()
    every: list[tuple[str, Any]] = []
    print("| system | u | gain | true | band | poles | true | held |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for seed, name in itertools.product(range(given.seeds), given.systems.split(",")):
        system, start = SYSTEMS[name], time.monotonic()
        number = list(SYSTEMS).index(name) + 100 * seed
        u, y = simulated(system, np.random.default_rng(number))
        named = name if seed == 0 else f"{name}{seed}"
        folder = given.runs / "problems" / named
        if not folder.exists():
            asia.Problem.from_arrays(
                u, y, sampling_time=system.step, directory=folder, inputs=["u"], outputs=["y"],
                physics=system.physics,
            )  # fmt: skip
        if given.direct:
            points, use = fitted(load_problem(folder), system.points, seed), "direct"
        else:
            run = asia.run(folder, experiments=given.experiments, runs=given.runs, name=named)
            linear = asia.linearize(run.directory, at=[f"u={value}" for value in system.points])
            points, use = linear.points, linear.use
        for value, point in zip(system.points, points, strict=True):
            gain, poles = truth(system, value)
            results = judged(point, gain, poles, system.step)
            every += results
            band = point.gain_band
            shown = "none" if band is None else f"{band[0][0, 0]:.3g} to {band[1][0, 0]:.3g}"
            own = ", ".join(f"{p:.4f}" for p in point.model.poles[:4])
            held = ", ".join(f"{n} {'no band' if ok is None else ok}" for n, ok in results)
            true = ", ".join(f"{p:.4f}" for p in poles)
            print(f"| {name} | {value} | {point.model.gain[0, 0]:.4g} | {gain:.4g} | {shown} "
                  f"| {own} | {true} | {held} |", flush=True)  # fmt: skip
        print(f"<!-- {name}: {use}, {time.monotonic() - start:.0f} s -->", flush=True)
    for kind in ("gain", "pole"):
        of = [ok for n, ok in every if n == kind]
        print(f"{kind}s inside their bands: {sum(ok is True for ok in of)} of {len(of)}; "
              f"without a band: {sum(ok is None for ok in of)}")  # fmt: skip
    print(f"in all {sum(ok is True for _, ok in every) / len(every):.0%}")


if __name__ == "__main__":
    main()
