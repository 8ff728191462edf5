"""Levenberg-Marquardt with exact derivatives against SciPy's least_squares with finite differences.

Both fit the same three parameters and two initial states of a two-tank ODE (Runge-Kutta of order
four, two steps a sample) to the same simulated record, from the same starts, with the same
residuals, on one thread. The time is that until the cost is within 0.1 % of the least one that
any reached from that start, read off the trace of evaluations; compilation is counted apart, and
starts from which not all reach it count for nothing.
SciPy runs twice: with the compiled residuals of our model, and with residuals of a NumPy loop,
which is what a script without JAX has.

    python benchmarks/models/lm.py --starts 8
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from asia.models._least_squares import LevenbergMarquardt, NormalEquations, minimise

Array = NDArray[np.float64]
SAMPLES, STEP, SUBSTEPS = 510, 4.0, 2
TRUTH = np.log([0.054, 0.044, 0.062])
TRUTH_START = np.concatenate([TRUTH, [4.0, 4.0]])
WITHIN = 1.001


def rates(xp: Any, k: Any, x: Any, u: Any) -> Any:
    """Two tanks in cascade, levels kept off zero; k (3,), x (2,)."""
    root = xp.sqrt(xp.maximum(x, 1e-6))
    return xp.stack([k[2] * u - k[0] * root[0], k[0] * root[0] - k[1] * root[1]])


def advanced(xp: Any, k: Any, x: Any, u: Any) -> Any:
    """One sample further."""
    h = STEP / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = rates(xp, k, x, u)
        k2 = rates(xp, k, x + 0.5 * h * k1, u)
        k3 = rates(xp, k, x + 0.5 * h * k2, u)
        k4 = rates(xp, k, x + h * k3, u)
        x = xp.maximum(x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), 0.0)
    return x


def levels_numpy(theta: Array, u: Array) -> Array:
    """Lower level (T,), by a loop; theta (5,): logs of the parameters, initial states."""
    k, x, y = np.exp(theta[:3]), theta[3:], np.empty(len(u))
    for i, now in enumerate(u):
        y[i] = x[1]
        x = advanced(np, k, x, now)
    return y


def levels_jax(theta: jax.Array, u: jax.Array) -> jax.Array:
    """The same, compiled."""
    k = jnp.exp(theta[:3])
    _, y = jax.lax.scan(lambda x, now: (advanced(jnp, k, x, now), x[1]), theta[3:], u)
    return y


@dataclass
class Trace:
    """Residuals whose cost is noted with the time since the first call."""

    residual: Callable[[Array], Array]
    began: float = 0.0

    def __post_init__(self) -> None:
        self.points: list[tuple[float, float]] = []

    def __call__(self, theta: Array) -> Array:
        self.began = self.began or time.perf_counter()
        value = self.residual(theta)
        self.points.append((time.perf_counter() - self.began, float(value @ value)))
        return value

    def seconds_to(self, cost: float) -> float:
        """Infinite where it was not reached."""
        return next((t for t, c in self.points if c <= cost), float("inf"))


def ours(residual: Any, theta0: Array) -> tuple[float, float, Array]:
    """Seconds of a fit over two compiled programs, seconds to compile them, and the cost by
    iteration."""
    method = LevenbergMarquardt(iterations=60)

    def normal(theta: Any) -> Any:
        jacobian, e = jax.jacfwd(lambda t: (residual(t),) * 2, has_aux=True)(theta)
        return e @ e, jacobian.T @ jacobian, jacobian.T @ e

    costs = jax.jit(jax.vmap(lambda theta: jnp.sum(residual(theta) ** 2)))
    equations, taken = jax.jit(normal), 0

    def linearise(theta: Array) -> NormalEquations:
        nonlocal taken
        taken += 1
        return NormalEquations(*(np.asarray(value)[None] for value in equations(theta[0])))

    def fit() -> Array:
        nonlocal taken
        taken = 0
        found = minimise(lambda t: np.asarray(costs(t[0]))[None], linearise, theta0[None], method)
        return found.history[0, : taken + 1]

    start = time.perf_counter()
    fit()
    compiled = time.perf_counter()
    history = fit()
    done = time.perf_counter()
    return done - compiled, 2 * compiled - start - done, history


def seconds_to(cost: float, seconds: float, history: Array) -> float:
    """Iterations cost alike, so the time to a cost follows from its place in the history."""
    reached = np.flatnonzero(history <= cost)
    if not len(reached):
        return float("inf")
    return seconds * max(int(reached[0]), 1) / max(len(history) - 1, 1)


def main() -> None:
    """Fit from every start with the three, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=8)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.8, 4.0, SAMPLES // 15 + 1), 15)[:SAMPLES]
    y = levels_numpy(TRUTH_START, u)
    y = y + 0.02 * y.std() * rng.standard_normal(SAMPLES)
    print(f"{SAMPLES} samples, {platform.machine()}, {os.cpu_count()} cores, one thread")
    print("| start | ours ms | (compile s) | SciPy, compiled residuals | SciPy, NumPy loop |")
    print("|---|---|---|---|---|")
    ratios: list[tuple[float, float]] = []
    with jax.enable_x64(True):
        compiled = jax.jit(lambda theta: levels_jax(theta, jnp.asarray(u)) - y)
        np.testing.assert_allclose(compiled(TRUTH_START), levels_numpy(TRUTH_START, u) - y)
        for i in range(options.starts):
            theta0 = np.concatenate([TRUTH + rng.normal(scale=0.15, size=3), [3.0, 3.0]])
            seconds, compile_seconds, history = ours(compiled, theta0)
            traces = (
                Trace(lambda theta: np.asarray(compiled(theta))),
                Trace(lambda theta: levels_numpy(theta, u) - y),
            )
            for trace in traces:
                least_squares(trace, theta0, x_scale="jac", ftol=1e-12, xtol=1e-12)
            least = min(history[-1], *(c for trace in traces for _, c in trace.points))
            own = seconds_to(WITHIN * least, seconds, history)
            others = [trace.seconds_to(WITHIN * least) for trace in traces]
            reached = np.isfinite([own, *others])
            if reached.all():
                ratios.append((others[0] / own, others[1] / own))
                cells = " | ".join(f"{other / own:.1f} x" for other in others)
            else:
                cells = " | ".join("reached" if r else "another minimum" for r in reached[1:])
            print(f"| {i + 1} | {1e3 * own:.1f} | {compile_seconds:.1f} | {cells} |", flush=True)
    if not ratios:
        raise SystemExit("from no start did all three reach the same cost; try more starts")
    medians = [statistics.median(r) for r in zip(*ratios, strict=True)]
    print(
        f"median of {len(ratios)} starts: SciPy takes {medians[0]:.1f} and {medians[1]:.1f} "
        "times as long"
    )


if __name__ == "__main__":
    main()
