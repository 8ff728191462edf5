"""Long records: peak memory, seconds and progress reports of fits, and how the seconds grow.

Each fit runs in a process of its own, on one thread, on one simulated single-input single-output
record; the memory is that process's peak resident set, JAX included. Seconds are processor seconds,
compiling included; growth is their ratio to those of the number of samples before, over the ratio
of the samples. Exits with 1 when a fit takes more than 4 GiB or reports no progress.

    python benchmarks/models/long_record.py --samples 500 5000 50000 500000 [--fits linear nl_lfr]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import cont2discrete

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import greybox, linear, neural_ss, nl_lfr
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import Adam
from asia.problem import ParameterRange, Physics

LIMIT_GIB = 4.0
PAST = 10

Train = Callable[[Sequence[Trajectory], Context], Any]


@dataclass(frozen=True)
class Case:
    """A name and a fit."""

    name: str
    train: Train


PHYSICS = Physics(
    states=("x", "v"),
    parameters={name: ParameterRange(0.03, 3.0) for name in ("stiffness", "friction", "gain")},
    dynamics={"x": "0.3*v", "v": "-stiffness*x - friction*v + gain*u"},
    observation={"y": "tanh(x)"},
)


def record(samples: int, seed: int = 0) -> Trajectory:
    """A second-order resonance with a softening output and sensor noise of 2 %."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, samples // 10 + 1), 10)[:samples]
    lag = np.array([[0.0, 0.3], [-0.3, -0.3]]), np.array([[0.0], [0.3]])
    a, b, *_ = cont2discrete((*lag, np.eye(2), np.zeros((2, 1))), 1.0)
    x, y = np.zeros(2), np.empty(samples)
    for k in range(samples):
        y[k] = np.tanh(x[0])
        x = a @ x + b[:, 0] * u[k]
    return Trajectory(u[:, None], y + 0.02 * y.std() * rng.standard_normal(samples), 1.0)


def fit_linear(records: Sequence[Trajectory], context: Context) -> Any:
    """Order chosen, then refined."""
    model = linear.build(linear.Config(), context)
    return linear.train(model, records, context, LevenbergMarquardt(iterations=10))


def fit_neural(records: Sequence[Trajectory], context: Context) -> Any:
    """Levenberg-Marquardt on the whole record."""
    model = neural_ss.build(neural_ss.Config(order=2), context)
    return neural_ss.train(model, records, context, LevenbergMarquardt(iterations=10))


def fit_neural_adam(records: Sequence[Trajectory], context: Context) -> Any:
    """Adam on chunks."""
    model = neural_ss.build(neural_ss.Config(order=2), context)
    return neural_ss.train(model, records, context, Adam(steps=100, truncation=200))


def fit_greybox(records: Sequence[Trajectory], context: Context) -> Any:
    """The system's equations, three unknown parameters."""
    model = greybox.build(greybox.Config(), context)
    return greybox.train(model, records, context, LevenbergMarquardt(iterations=25, starts=2))


def fit_nl_lfr(records: Sequence[Trajectory], context: Context) -> Any:
    """As the first of its family in a search."""
    model = nl_lfr.build(nl_lfr.Config(), context)
    return nl_lfr.train(model, records, context, LevenbergMarquardt(iterations=60, starts=2))


CASES = (
    Case("greybox", fit_greybox),
    Case("nl_lfr", fit_nl_lfr),
    Case("linear", fit_linear),
    Case("neural_ss, Levenberg-Marquardt", fit_neural),
    Case("neural_ss, Adam", fit_neural_adam),
)


def child(index: int, samples: int) -> None:
    """Fit in this process and print the figures."""
    data = record(samples)
    losses: list[float] = []
    context = Context(
        (Signal("u"),), (Signal("y"),), 1.0, PAST, PAST, physics=PHYSICS,
        log=lambda _, loss: losses.append(loss),
    )  # fmt: skip
    start = time.process_time()
    model = CASES[index].train([data], context)
    seconds = time.process_time() - start
    u, y = data.u[None, :2000], data.y[None, :2000]
    y_hat = model.simulate(u[:, :PAST], y[:, :PAST], u[:, PAST:])
    error = np.sqrt(np.mean((y_hat - y[:, PAST:]) ** 2)) / data.y.std()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{peak:.3f} {seconds:.1f} {len(losses)} {error:.4f}")


def main() -> None:
    """Run every case and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, nargs="+", default=[100_000])
    parser.add_argument("--fits", nargs="+", default=[], help="beginnings of their names")
    parser.add_argument("--child", type=int, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        child(options.child, *options.samples)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores")
    print("| fit | samples | peak GiB | seconds | growth | reports | training error / std |")
    print("|---|---|---|---|---|---|---|")
    passed = True
    for i, case in enumerate(CASES):
        if options.fits and not case.name.startswith(tuple(options.fits)):
            continue
        before = None
        for samples in options.samples:
            command = [sys.executable, __file__, "--samples", str(samples), "--child", str(i)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            peak, seconds, reports, error = done.stdout.split()
            growth = ""
            if before is not None:
                growth = f"{float(seconds) / before[1] * before[0] / samples:.2f}"
            before = samples, float(seconds)
            cells = case.name, samples, peak, seconds, growth, reports, error
            print("|", *(f"{cell} |" for cell in cells), flush=True)
            passed = passed and float(peak) <= LIMIT_GIB and int(reports) > 1
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
