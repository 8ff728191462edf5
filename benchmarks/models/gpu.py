"""Network families on an NVIDIA GPU against two processor cores of the same machine.

    python benchmarks/models/gpu.py [--families lstm transformer] [--updates 200] [--cores 0,1]

Two generated sets: "flights", twelve records of 1 000 samples with 4 inputs and 12 outputs,
simulated in windows of 50 samples from the past sample; and "long", one Wiener-Hammerstein record
of 100 000 samples, trained on chunks. Every fit runs twice, each time in a process of its own: with
JAX on the GPU, and on the two cores. Update: median seconds of an update after the first report;
fit: seconds of the whole fit, compiling included; error: root mean square error, in standard
deviations, at the start of the first training record (one window, or 20 000 samples); gain: ratio
of the two fits. A fit that fails prints its reason. Needs JAX with CUDA and taskset.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.signal import lfilter

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import cnn, ltc, neural_ss, nl_lfr, recurrent, subnet, transformer
from asia.models._least_squares import LevenbergMarquardt
from asia.models.methods import Adam

Record = Sequence[Trajectory]
NETWORKS: dict[str, tuple[Any, dict[str, Any]]] = {
    "lstm": (recurrent, {"cell": "lstm"}),
    "ltc": (ltc, {}),
    "cnn": (cnn, {}),
    "transformer": (transformer, {}),
    "subnet": (subnet, {}),
}
LEAST_SQUARES: dict[str, tuple[Any, dict[str, Any]]] = {
    "neural_ss": (neural_ss, {"order": 6}),
    "nl_lfr": (nl_lfr, {"order": 6}),
}


def flights() -> tuple[Record, Context]:
    """Four inputs drive twelve coupled states through bounded functions."""
    rng = np.random.default_rng(0)
    a = 0.9 * np.linalg.qr(rng.standard_normal((12, 12)))[0]
    b = 0.3 * rng.standard_normal((4, 12))
    records: list[Trajectory] = []
    for _ in range(12):
        u = np.repeat(rng.uniform(-1.0, 1.0, (100, 4)), 10, axis=0)
        y, x = np.empty((1000, 12)), np.zeros(12)
        for k in range(1000):
            y[k] = x
            x = np.tanh(x @ a + u[k] @ b)
        records.append(Trajectory(u, y + 0.01 * rng.standard_normal(y.shape), 0.01))
    names = tuple(Signal(f"u{k}") for k in range(4)), tuple(Signal(f"y{k}") for k in range(12))
    return records, Context(*names, 0.01, 1, 1, horizon=50)


def long() -> tuple[Record, Context]:
    """A static function between two filters."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal(100_000)
    inner = np.asarray(lfilter([0.2, 0.1], [1.0, -1.2, 0.5], u))
    y = np.asarray(lfilter([0.3, 0.1], [1.0, -0.9, 0.3], np.where(inner > 0, inner, 0.3 * inner)))
    y = y + 0.01 * y.std() * rng.standard_normal(len(y))
    names = (Signal("u"),), (Signal("y"),)
    return [Trajectory(u[:, None], y[:, None], 1.0)], Context(*names, 1.0, 50, 50)


LONGEST = 100
RECORDS: dict[str, Callable[[], tuple[Record, Context]]] = {"flights": flights, "long": long}


def child(name: str, records: str, updates: int) -> None:
    """Fit in this process and print the figures."""
    import jax

    data, context = RECORDS[records]()
    at: list[tuple[float, float]] = []
    context = replace(context, log=lambda step, _: at.append((float(step), time.perf_counter())))
    if name in NETWORKS:
        module, settings = NETWORKS[name]
        chunk = 256 if records == "long" else None
        method: Any = Adam(updates, 1e-3, schedule="constant", truncation=chunk)
    else:
        module, settings = LEAST_SQUARES[name]
        method = LevenbergMarquardt(iterations=10)
    begin = time.perf_counter()
    model = module.train(module.build(module.Config(**settings), context), data, context, method)
    took = time.perf_counter() - begin
    pace = [(s - r) / (k - j) for (j, r), (k, s) in pairwise(at[1:]) if k > j]
    whole = data[0]
    start = context.n_past_u
    length = min(len(whole.y), 20_000) if context.horizon is None else start + context.horizon
    made = model.simulate(
        whole.u[None, :start], whole.y[None, :start], whole.u[None, start:length]
    )[0]  # fmt: skip
    error = (made - whole.y[start:length]) / whole.y.std(axis=0)
    figures = {
        "device": jax.devices()[0].device_kind,
        "update": statistics.median(pace) if pace else float("nan"),
        "fit": took,
        "error": float(np.sqrt(np.mean(error**2))),
    }
    print(json.dumps(figures))


def measured(name: str, records: str, updates: int, cores: str, platform: str) -> Any:
    """Figures of one fit in a process of its own, or the last line of what it said."""
    child = [sys.executable, __file__, "--child", name, records, str(updates)]
    environment = {
        **os.environ, "JAX_PLATFORMS": platform, "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }  # fmt: skip
    try:
        done = subprocess.run(
            ["taskset", "-c", cores, *child],
            env=environment, capture_output=True, text=True, check=False, timeout=LONGEST,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"over {LONGEST} s"
    if done.returncode == 0:
        return json.loads(done.stdout.strip().splitlines()[-1])
    return [line for line in done.stderr.splitlines() if "Error" in line][-1][:200]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--families", nargs="+", default=[*NETWORKS, *LEAST_SQUARES])
    parser.add_argument("--records", nargs="+", default=list(RECORDS))
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--cores", default="0,1", help="cores without the GPU")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.child[0], given.child[1], int(given.child[2]))
        return
    given_cores = {int(core) for core in given.cores.split(",")}
    others = ",".join(str(core) for core in sorted(os.sched_getaffinity(0) - given_cores))
    print(f"load {os.getloadavg()[0]:.1f}")
    print("| records | family | GPU: ms | fit s | error | cores: ms | fit s | error | gain |")
    print("|---|---|---|---|---|---|---|---|---|")
    for records in given.records:
        for name in given.families:
            # Side by side, each with cores of its own.
            with ThreadPoolExecutor(2) as pool:
                ours = pool.submit(measured, name, records, given.updates, others, "cuda")
                theirs = pool.submit(measured, name, records, given.updates, given.cores, "cpu")
            both = [ours.result(), theirs.result()]
            cells = [records, name]
            for one in both:
                cells += (
                    [one, "", ""]
                    if isinstance(one, str)
                    else [f"{1e3 * one['update']:.2f}", f"{one['fit']:.1f}", f"{one['error']:.3f}"]
                )
            good = not any(isinstance(one, str) for one in both)
            cells.append(f"{both[1]['fit'] / both[0]['fit']:.2f}" if good else "")
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
