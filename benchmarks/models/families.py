"""Parametric model families on a system of their own class: one row a family.

The figure is the simulation error on fresh noisy data over that of the noise-free truth, 1 at best,
at most 1.2 wanted. A row is an entry of ROWS.

    python benchmarks/models/families.py [family ...]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import arx, block_oriented, linear, narx, neural_ss
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import LeastSquares

Array = NDArray[np.float64]
Respond = Callable[[Array, Array], Array]
"""u (T,) and equation noise (T,) -> output (T,)."""

SAMPLES, FRESH, PAST, NOISE = 1000, 600, 10, 0.05


@dataclass(frozen=True)
class System:
    """A generated system; noise enters the equation, or is added to the output."""

    respond: Respond
    in_equation: bool = False


@dataclass(frozen=True)
class Row:
    """A family with the settings it is judged with, on a system of SYSTEMS."""

    module: ModuleType
    config: Any
    method: Any
    system: str


def filtered(u: Array, poles: tuple[complex, ...], gain: float) -> Array:
    """Strictly proper all-pole filter with this static gain."""
    a = np.real(np.poly(poles))
    b = gain * a.sum()
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        past = sum(-a[i] * y[k - i] for i in range(1, min(k, len(a) - 1) + 1))
        y[k] = past + b * u[k - 1]
    return y


RESONANCE, LAG = (0.8 + 0.3j, 0.8 - 0.3j), (0.8,)


def _difference(u: Array, e: Array) -> Array:
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.5 * u[k - 1] + 0.2 * u[k - 2] + e[k]
    return y


def _bilinear(u: Array, e: Array) -> Array:
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        line = 0.6 * y[k - 1] - 0.1 * y[k - 2] + 0.4 * u[k - 1]
        y[k] = line + 0.15 * u[k - 1] ** 2 - 0.1 * y[k - 1] * u[k - 2] + e[k]
    return y


def _state_space(u: Array, e: Array) -> Array:
    x, y = np.zeros(2), np.zeros(len(u))
    for k in range(len(u)):
        y[k] = x[0] + 0.5 * x[1] + e[k]
        spring = 0.3 * np.tanh(1.5 * x[0])
        x = np.array([0.8 * x[0] + 0.3 * x[1] + 0.2 * u[k], 0.8 * x[1] - spring + 0.1 * u[k]])
    return y


SYSTEMS: dict[str, System] = {
    "difference equation": System(_difference, in_equation=True),
    "linear": System(lambda u, e: filtered(u, RESONANCE, 1.0) + e),
    "bilinear": System(_bilinear, in_equation=True),
    "bilinear, output noise": System(lambda u, e: _bilinear(u, np.zeros(len(u))) + e),
    "hammerstein": System(lambda u, e: filtered(np.tanh(2 * u), RESONANCE, 1.0) + e),
    "wiener": System(lambda u, e: np.tanh(1.5 * filtered(u, RESONANCE, 1.0)) + e),
    "hammerstein_wiener": System(
        lambda u, e: np.tanh(1.5 * filtered(np.tanh(2 * u), RESONANCE, 1.0)) + e
    ),
    "wiener_hammerstein": System(
        lambda u, e: filtered(np.tanh(2 * filtered(u, RESONANCE, 1.0)), LAG, 1.0) + e
    ),
    "nonlinear state-space": System(_state_space),
}


def _static(place: Any, system: str) -> Row:
    return Row(
        neural_ss, neural_ss.Config(order=2, nonlinearity=place), LevenbergMarquardt(60), system
    )


ROWS: tuple[Row, ...] = (
    Row(arx, arx.Config(structure="arx"), LeastSquares(), "difference equation"),
    Row(arx, arx.Config(structure="oe"), LevenbergMarquardt(30), "linear"),
    Row(linear, linear.Config(), LevenbergMarquardt(30), "linear"),
    Row(narx, narx.Config(), LeastSquares(), "bilinear"),
    Row(narx, narx.Config(), LevenbergMarquardt(30), "bilinear, output noise"),
    _static("input", "hammerstein"),
    _static("output", "wiener"),
    _static("both", "hammerstein_wiener"),
    Row(
        block_oriented, block_oriented.Config(order=3), LevenbergMarquardt(60, starts=4),
        "wiener_hammerstein",
    ),
    Row(
        neural_ss, neural_ss.Config(order=2), LevenbergMarquardt(60, starts=2),
        "nonlinear state-space",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Data:
    """Training record, fresh record, and what the fresh one is without noise (T, 1)."""

    training: Trajectory
    fresh: Trajectory
    truth: Array


def draw(system: System, seed: int) -> Data:
    """Inputs held for three samples; noise of NOISE times the output's standard deviation."""
    rng = np.random.default_rng(seed)
    inputs = [np.repeat(rng.standard_normal(n // 3 + 1), 3)[:n] for n in (SAMPLES, FRESH)]
    quiet = [system.respond(u, np.zeros(len(u))) for u in inputs]
    size = NOISE * quiet[0].std() * (0.3 if system.in_equation else 1.0)
    noisy = [system.respond(u, size * rng.standard_normal(len(u))) for u in inputs]
    records = [Trajectory(u[:, None], y[:, None], 1.0) for u, y in zip(inputs, noisy, strict=True)]
    return Data(records[0], records[1], quiet[1][:, None])


def simulated(module: ModuleType, config: Any, method: Any, data: Data) -> Array:
    """Fit, then simulation of the fresh record after its past window, (T, 1)."""
    context = Context((Signal("u"),), (Signal("y"),), 1.0, PAST, PAST, seed=1)
    model = module.train(module.build(config, context), [data.training], context, method)
    u, y = data.fresh.u[None], data.fresh.y[None]
    return np.asarray(model.simulate(u[:, :PAST], y[:, :PAST], u[:, PAST:])[0])


def figure(row: Row, seed: int) -> float:
    """Error over noise."""
    data = draw(SYSTEMS[row.system], seed)
    y = simulated(row.module, row.config, row.method, data)
    measured, truth = data.fresh.y[PAST:], data.truth[PAST:]
    return _rms(y - measured) / _rms(truth - measured)


def _rms(error: Array) -> float:
    return float(np.sqrt((error**2).mean()))


def main() -> None:
    """Print the table, medians over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("families", nargs="*", help="modules of asia.models, all when left out")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    print("| family | system | median | worst | wanted | s a fit |")
    print("|---|---|---|---|---|---|")
    for row in ROWS:
        name = row.module.__name__.rpartition(".")[2]
        if options.families and name not in options.families:
            continue
        start = time.monotonic()
        values = [figure(row, seed) for seed in options.seeds]
        seconds = (time.monotonic() - start) / len(values)
        label = f"{name} ({row.config.structure})" if hasattr(row.config, "structure") else name
        print(
            f"| {label} | {row.system} | {np.median(values):.3f} | {max(values):.3f} | 1.2 | "
            f"{seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
