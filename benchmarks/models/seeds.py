"""Fits of each family from different seeds: share that ends within 10 % of the best fit."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.models import block_oriented, linear, neural_ss, nl_lfr
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Signal

sys.path.insert(0, str(Path(__file__).parents[1] / "searches"))
from systems import KINDS, PAST, make_system

# Family: module, first configuration of the expert.
FAMILIES: dict[str, tuple[Any, Any]] = {
    "linear": (linear, linear.Config(order=None, delay=None, periodic=True)),
    "neural_ss": (neural_ss, neural_ss.Config(delay=None, past_fit=True)),
    "nl_lfr": (nl_lfr, nl_lfr.Config()),
    "block_oriented": (
        block_oriented,
        block_oriented.Config(delay=None),
    ),
}
SYSTEMS = "duffing,bilinear,wiener_hammerstein,mimo,friction,tanks"
NEAR = 1.1


def main() -> None:
    """Print a row for each family and system, then the share of each family."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--systems", default=SYSTEMS)
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--samples", type=int, default=1000, help="training samples, at most 1000")
    options = parser.parse_args()
    shares: dict[str, list[bool]] = {}
    print("| family | system | fits | within 10 % of the best | median / best | worst / best | s |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for family in options.families.split(","):
        for name in options.systems.split(","):
            start = time.monotonic()
            errors = np.array(
                [_error(family, name, seed, options.samples) for seed in range(options.fits)]
            )
            ratio = errors / errors.min()
            near = ratio <= NEAR
            shares.setdefault(family, []).extend(near.tolist())
            cells = f"{near.mean():.0%} | {np.median(ratio):.3g} | {ratio.max():.3g}"
            seconds = time.monotonic() - start
            print(f"| {family} | {name} | {len(near)} | {cells} | {seconds:.0f} |", flush=True)
    for family, near in shares.items():
        print(f"| **{family}** | all | {len(near)} | {np.mean(near):.0%} | | | |")


def _error(family: str, name: str, seed: int, samples: int) -> float:
    """Free-run error on the training record, in standard deviations of the output; infinite where
    the fit fails."""
    record = make_system(KINDS[name], 100).train
    u, y = record.u[:samples], record.y[:samples]
    context = Context(
        tuple(Signal(f"u{i + 1}") for i in range(u.shape[1])),
        tuple(Signal(f"y{i + 1}") for i in range(y.shape[1])),
        KINDS[name].sampling_time, n_past_u=PAST, n_past_y=PAST, seed=seed,
    )  # fmt: skip
    module, config = FAMILIES[family]
    method = LevenbergMarquardt(iterations=60, starts=2)
    trajectory = Trajectory(u, y, context.sampling_time, "train")
    try:
        model = module.train(module.build(config, context), [trajectory], context, method)
    except (ValueError, FloatingPointError, np.linalg.LinAlgError):
        return np.inf
    y_hat = model.simulate(u[None, :PAST], y[None, :PAST], u[None, PAST:])[0]
    wrong = np.sqrt(np.mean((y[PAST:] - y_hat) ** 2, axis=0)) / y.std(axis=0)
    return float(np.mean(wrong)) if np.isfinite(wrong).all() else np.inf


if __name__ == "__main__":
    main()
