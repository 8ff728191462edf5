"""Do random runs leave a certified tube, and how wide is it? Five families, fitted small.

    nice python benchmarks/control/certificates.py [--runs 20000] [--samples 50] [--range 0.3]

Each family of the library is fitted as the benchmark of exports does, and certified for inputs in
the middle part of the records' range. The random runs hold inputs at the limits for random times,
or draw them anew in each sample. The width at the last sample is compared with that of these runs,
and with a bound from below: constant inputs at the limits and the worst input of the linear model.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "models"))

from exports import ready, settings

from asia.agents.library.registry import all_families
from asia.control.certificate import certify
from asia.lowering.derivatives import derivatives
from asia.lowering.evaluation import evaluate
from asia.lowering.linear import joined, split
from asia.lowering.program import LoweredModel

FAMILIES = "linear,arx,narx,neural_ss,block_oriented"


def main() -> None:
    """Certify, simulate and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, add_help=True)
    parser.add_argument("--families", default=FAMILIES)
    parser.add_argument("--runs", type=int, default=20_000)
    parser.add_argument("--samples", type=int, default=50)
    parser.add_argument("--range", type=float, default=0.3)
    options = parser.parse_args()
    print("| family | states | seconds | tube | random runs | worst found | ratio | left | box |")
    print("|---|---|---|---|---|---|---|---|---|")
    for family in all_families():
        if family.name not in options.families.split(","):
            continue
        given = ready(family, settings(family)[0])
        if isinstance(given, str):
            print(f"| {family.name} | {given} |")
            continue
        model, window, span = given.model.lowered, given.windows[0], given.model.input_range
        middle = span.mean(axis=1, keepdims=True)
        u = middle + options.range * (span - middle)
        start = joined(evaluate(model.initial, [window.past_u, window.past_y, u.mean(axis=1)]))
        began = time.perf_counter()
        content = certify(model, u, start, options.samples, {"assumptions": []})
        seconds = time.perf_counter() - began
        kinds = {one["kind"]: one for one in content["statements"]}
        states = len(start)
        if "tube" not in kinds:
            print(f"| {family.name} | {states} | {seconds:.1f} | none: {content['missed']} |")
            continue
        low, high = (np.array(kinds["tube"][side]) for side in ("lower", "upper"))
        runs = simulated(model, start, drawn_inputs(u, options.runs, options.samples))
        left = int(((runs < low) | (runs > high)).any(axis=(1, 2)).sum())
        wide = float((high - low)[-1].max())
        random = float((runs.max(axis=0) - runs.min(axis=0))[-1].max())
        worst = worst_inputs(model, start, u, options.samples)
        found = simulated(model, start, worst)
        extreme = float(np.ptp(np.concatenate([runs, found])[:, -1], axis=0).max())
        left += int(((found < low) | (found > high)).any(axis=(1, 2)).sum())
        print(
            f"| {family.name} | {states} | {seconds:.1f} | {wide:.4g} | {random:.4g} | "
            f"{extreme:.4g} | {wide / extreme:.2f} | {left} of {len(runs) + len(found)} | "
            f"{'yes' if 'invariant box' in kinds else 'no'} |",
            flush=True,
        )


def drawn_inputs(u: np.ndarray, runs: int, samples: int) -> np.ndarray:
    """Random inputs (runs, samples, nu): a third each held at limits, held anywhere, and new in
    each sample."""
    rng = np.random.default_rng(0)
    share = rng.random((runs, samples, len(u)))
    third = runs // 3
    for r in range(2 * third):
        k = 0
        while k < samples:
            length = int(rng.integers(1, samples))
            value = share[r, k]
            share[r, k : k + length] = np.round(value) if r < third else value
            k += length
    return u[:, 0] + (u[:, 1] - u[:, 0]) * share


def worst_inputs(model: LoweredModel, start: np.ndarray, u: np.ndarray, samples: int) -> np.ndarray:
    """Inputs at the limits by the signs of the impulse response along the middle trajectory."""
    n, x, middle = len(start), start, u.mean(axis=1)
    slopes = []
    for _ in range(samples):
        _, slope = derivatives(model.step, [*split(model, x), middle])
        slopes.append(slope)
        x = joined(evaluate(model.update, [*split(model, x), middle]))
    found = []
    for i in range(model.ny):
        inputs = np.empty((samples, model.nu))
        inputs[-1] = slopes[-1][i, n:]
        row = slopes[-1][i, :n]
        for k in range(samples - 2, -1, -1):
            inputs[k] = row @ slopes[k][model.ny :, n:]
            row = row @ slopes[k][model.ny :, :n]
        found += [np.where(inputs > 0, u[:, 1], u[:, 0]), np.where(inputs > 0, u[:, 0], u[:, 1])]
    return np.stack(found)


def simulated(model: LoweredModel, start: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Outputs (runs, samples, ny)."""
    found = np.empty((len(inputs), inputs.shape[1], model.ny))
    begin = split(model, start)
    for one, sequence in zip(found, inputs, strict=True):
        states = begin
        for k, row in enumerate(sequence):
            one[k], *states = evaluate(model.step, [*states, row])
    return found


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
