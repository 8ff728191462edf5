"""Do the 95 % intervals of process models cover the truth?

50 generated records with noise, half of them steps and half binary sequences: gain, one or two
lags, a delay between samples, some with a zero or an integrator. The structure is given, or chosen
by the Bayesian information criterion.

    python benchmarks/models/process.py [--records 50] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np

from asia.analysis.process import ProcessStructure, fit_process
from asia.data import Trajectory
from asia.lowering.linear import ProcessModel


def record(rng: np.random.Generator, kind: str) -> tuple[Trajectory, ProcessModel]:
    """A record that begins at rest, and the model that it is made with."""
    lags = int(rng.integers(1, 3))
    zero, integrator = bool(lags == 2 and rng.random() < 0.3), bool(rng.random() < 0.2)
    slow = rng.uniform(8.0, 25.0)
    times = [slow, slow * rng.uniform(0.2, 0.6)][:lags]
    gain = rng.uniform(0.5, 3.0) * rng.choice([-1.0, 1.0]) * (0.02 if integrator else 1.0)
    lead = times[0] * rng.uniform(-1.0, 0.5) if zero else 0.0
    model = ProcessModel(gain, tuple(times), lead, rng.uniform(0.0, 8.0), integrator, 0.0)
    samples, t = 600, np.arange(600.0)
    if kind == "step":
        moves = {20: 1.0, 220: -1.6, 420: 1.1}
    else:
        signs = rng.choice([-1.0, 1.0], 60)
        edges = np.flatnonzero(np.diff(signs, prepend=0.0))
        moves = {20 + 9 * int(k): float(np.diff(signs, prepend=0.0)[k]) for k in edges}
    u, y = np.zeros(samples), np.full(samples, 1.5)
    for start, size in moves.items():
        u[start:] += size
        y[start:] += size * model.step(t[: samples - start])
    y += rng.uniform(0.03, 0.1) * y.std() * rng.normal(size=samples)
    return Trajectory(u[:, None], y[:, None], 1.0, kind), model


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--records", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    held, tried = Counter[tuple[str, str, str]](), Counter[tuple[str, str, str]]()
    found_structure, seconds = 0, 0.0
    for number in range(given.records):
        kind = "step" if number % 2 else "binary"
        made, true = record(rng, kind)
        structure = ProcessStructure(len(true.lags), true.zero != 0.0, true.integrator)
        values = {"gain": true.gain, "delay": true.delay, "zero": true.zero}
        values |= {f"time constant {k}": lag for k, lag in enumerate(true.lags, 1)}
        for how, asked in (("given", structure), ("chosen", None)):
            start = time.perf_counter()
            found = fit_process([made], structure=asked)
            if asked is None:
                seconds += time.perf_counter() - start
                found_structure += found.structure == structure
                if found.structure != structure:
                    print(f"{number} {kind}: true {true}, found {found.models[0]}")
                    continue
            for one in found.parameters[0]:
                key = how, kind, one.name
                tried[key] += 1
                inside = one.low <= values[one.name] <= one.high
                held[key] += inside
                if not inside:
                    print(f"{number} {kind} {how}: {one.name} is {values[one.name]:.4g}, interval "
                          f"{one.low:.4g} to {one.high:.4g}")  # fmt: skip
    print("\nstructure | input | parameter | covered")
    for key in sorted(tried):
        print(" | ".join(key), "|", f"{held[key]} of {tried[key]}")
    for how in ("given", "chosen"):
        good = sum(n for key, n in held.items() if key[0] == how)
        of = sum(n for key, n in tried.items() if key[0] == how)
        print(f"structure {how}: {good} of {of} intervals ({good / of:.1%}) hold the truth")
    print(f"true structure chosen: {found_structure} of {given.records}; "
          f"{seconds / given.records:.1f} s a choice")  # fmt: skip


if __name__ == "__main__":
    main()
