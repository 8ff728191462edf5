"""How many records without bad samples are reported, and how many planted bad samples are found?

    python benchmarks/data/bad_samples.py [--records 300] [--seed 0] [--zoo DIRECTORY]

The records: white, held and stepped inputs, one to three; linear plants with a saturation, a dead
zone or a quantised sensor in places; white or coloured noise, or none.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from asia.data import Trajectory
from asia.data.bad_samples import BadSamples, find_bad_samples
from asia.problem.load import load_problem

KINDS = ("outlier", "code", "frozen", "overflow")


def clean(rng: np.random.Generator) -> Trajectory:
    """One record without a fault."""
    count, inputs = int(rng.integers(200, 3000)), int(rng.integers(1, 4))
    u = np.empty((count, inputs))
    for i in range(inputs):
        hold = int(rng.choice(np.array([1, 5, 20, 100])))
        levels = rng.normal(size=count // hold + 1)
        kind = int(rng.integers(4))
        if kind == 1:
            levels = np.sign(levels)
        u[:, i] = np.repeat(levels, hold)[:count]
        if kind == 2:
            u[:, i] = np.sin(np.arange(count) * rng.uniform(0.001, 0.3))
        if kind == 3:
            u[: count // 4, i] = 0.0
    pole, gain = rng.uniform(0.5, 0.995), rng.normal(size=inputs)
    y, delay = np.zeros(count), int(rng.integers(0, 20))
    for k in range(1, count):
        drive = u[max(k - 1 - delay, 0)] @ gain if k > delay else 0.0
        y[k] = pole * y[k - 1] + (1.0 - pole) * drive
    spread = float(y.std()) or 1.0
    noise = rng.normal(size=count) * float(rng.choice(np.array([0.0, 0.02, 0.1]))) * spread
    if rng.random() < 0.3:
        noise = np.convolve(noise, np.ones(5) / 5, "same")
    kind = int(rng.integers(5))
    if kind == 1:
        y = np.clip(y, -spread, spread)
    if kind == 2:
        y = np.where(np.abs(y) < 0.3 * spread, 0.0, y)
    y = y + noise
    if kind in (3, 4):
        step = spread * float(rng.choice(np.array([0.01, 0.1, 0.5])))
        y = np.round(y / step) * step
    return Trajectory(u, np.round(y, 8), 1.0, "r")


def planted(rng: np.random.Generator, record: Trajectory, kind: str) -> tuple[Trajectory, int]:
    """The record with one fault, and the row of it."""
    y = record.y.copy()
    row = int(rng.integers(len(y) // 3, 2 * len(y) // 3))
    spread = float(y.std())
    if kind == "outlier":
        y[row] += 15.0 * spread * rng.choice(np.array([-1.0, 1.0]))
    elif kind == "code":
        y[row] = -9999.0 if spread > 50 else 999.9
    elif kind == "frozen":
        y[row : row + 60] = y[row]
    else:
        slope = np.linspace(0.0, 1400.0, len(y)) + 3.0 * record.y[:, 0] / (spread or 1.0)
        y[:, 0] = np.round(slope) % 1024
        row = int(np.argmin(np.diff(y[:, 0]))) + 1
    return Trajectory(record.u, y, 1.0, "r"), row + 1


def search(record: Trajectory) -> tuple[BadSamples, ...]:
    names = [f"u{k}" for k in range(record.u.shape[1])]
    return find_bad_samples([record], names, ["y"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--zoo", type=Path)
    options = parser.parse_args()
    alarms: Counter[str] = Counter()
    found: Counter[str] = Counter()
    for k in range(options.records):
        rng = np.random.default_rng([options.seed, k])
        record = clean(rng)
        kinds = {one.kind for one in search(record)}
        alarms.update(kinds)
        alarms["any"] += bool(kinds)
        for kind in KINDS:
            bad, row = planted(rng, record, kind)
            found[kind] += any(b.kind == kind and abs(b.first - row) < 2 for b in search(bad))
    print(f"{options.records} records without a fault: {alarms['any']} reported", dict(alarms))
    print("planted and named by row:", {k: f"{found[k] / options.records:.0%}" for k in KINDS})
    for folder in sorted(options.zoo.glob("*/problem.toml")) if options.zoo else ():
        problem = load_problem(folder.parent)
        names = [[s.name for s in side] for side in (problem.inputs, problem.outputs)]
        print(folder.parent.name, [str(b) for b in find_bad_samples(problem.train, *names)])


if __name__ == "__main__":
    main()
