"""How inputs that move between samples are fitted: equations with held, linear and band-limited
inputs, on training records of Silverbox.

The equations of the problem file, with an offset of the output, are fitted to the beginning of a
realisation and simulated on that of realisations of the other groups. The error is that of V: root
mean square over the standard deviation of the output. The last line has the ratio of V with held
inputs to that with the others. The sealed test is not opened.

    ASIA_DATA_DIR=... python benchmarks/models/intersample.py --samples 4096
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from statistics import fmean

import numpy as np

from asia.data.statistics import staircases
from asia.data.trajectory import INTERSAMPLE
from asia.judge.evaluation.fold_fits import search_context
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.problem.load import load_problem

METHOD = LevenbergMarquardt(iterations=40, starts=4)
REALISATIONS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=4096, help="of each realisation")
    samples = parser.parse_args().samples
    problem = load_problem("silverbox")
    context, before = search_context(problem, 0), problem.protocol.past_inputs
    # The setting of the problem file, if it has one, would decide.
    context = replace(context, inputs=(replace(context.inputs[0], intersample=None),))
    first, *others = (record[:samples] for record in problem.train[:REALISATIONS])
    print(f"{len(first)} samples of {first.name}, staircase: {staircases([first])[0]}")
    found: dict[str, float] = {}
    for kind, name in INTERSAMPLE.items():
        started = time.perf_counter()
        config = greybox.Config(offset=("displacement_voltage",), intersample=kind)
        model = greybox.train(greybox.build(config, context), [first], context, METHOD)
        seconds, errors = time.perf_counter() - started, list[float]()
        for record in others:
            past_u, past_y, u = record.u[None, :before], record.y[None, :before], record.u[None]
            y = model.simulate(past_u, past_y, u[:, before:])[0]
            errors.append(float(np.sqrt(((y - record.y[before:]) ** 2).mean()) / first.y.std()))
        found[name] = fmean(errors)
        shown = ", ".join(f"{k} {v:.5g}" for k, v in model.parameters().items())
        print(f"{name:<13} V {found[name]:.4f}  {seconds:5.1f} s  {shown}", flush=True)
    ratios = ", ".join(f"{found['held'] / v:.1f} ({name})" for name, v in list(found.items())[1:])
    print(f"V of held inputs over that of others: {ratios}")


if __name__ == "__main__":
    main()
