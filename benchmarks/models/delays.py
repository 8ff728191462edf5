"""Seconds of a fit of equations with a learned delay or plug flow, against a fixed delay, and
their C.

All fit one record of the same tank behind a pipe, from the same starts, with the same number of
Jacobians, on one thread, in turns. The fixed delay is one of whole samples that the record holds
already, so that its equations remember nothing. Compilation is left out: the first fit of each
counts for nothing. For the last model of each: bytes of its C, processor seconds of compiling it,
and the largest difference of its simulation in C from ASIA's, over the spread of the output;
the largest difference of the derivatives of a step in its lowered program from finite differences.

    python benchmarks/models/delays.py --samples 1000 --repeats 3
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import resource
import tempfile
import time
from pathlib import Path
from statistics import median

import jax
import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.data.segment import SimulatedSegment
from asia.export.model import ExportModel
from asia.export.target import difference
from asia.export.targets.c import CTarget, c_compiler, compile_c
from asia.lowering.derivatives import derivatives
from asia.lowering.evaluation import evaluate
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.problem import ParameterRange, Physics

STEP, DEAD = 1.0, 6.0
TANK = {"a": ParameterRange(0.02, 0.5), "b": ParameterRange(0.2, 3.0)}
CASES: dict[str, tuple[str, str, dict[str, ParameterRange]]] = {
    "fixed": ("held", "x", {}),
    "delay of an input": ("delay(s, dead)", "x", {"dead": ParameterRange(1.0, 15.0)}),
    "plug flow of an input": (
        "plug_flow(s, q, volume)",
        "x",
        {"volume": ParameterRange(1.0, 10.0)},
    ),
    "lag of an input": ("lag(s, dead)", "x", {"dead": ParameterRange(1.0, 15.0)}),
    "delay of a state": ("s", "delay(x, dead)", {"dead": ParameterRange(1.0, 15.0)}),
    "plug flow of a state": ("s", "plug_flow(x, q, volume)", {"volume": ParameterRange(1.0, 10.0)}),
}


def main() -> None:
    """Print median seconds of a fit, their ratio to the fixed delay, and measures of the C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    spent: dict[str, list[float]] = {name: [] for name in CASES}
    printed: dict[str, str] = {}
    for repeat in range(options.repeats + 1):
        for name in CASES:
            model, record, context, seconds = fit(name, options.samples, options.iterations)
            if repeat:
                spent[name].append(seconds)
            if repeat == options.repeats:
                printed[name] = c_measures(model, record, context)
    fixed = median(spent["fixed"]) if spent["fixed"] else float("nan")
    for name, seconds in spent.items():
        least = median(seconds) if seconds else float("nan")
        print(f"{name:24}{least:8.2f} s{least / fixed:8.2f}{printed[name]}")


def c_measures(model: greybox.GreyBox, record: Trajectory, context: Context) -> str:
    """Bytes, seconds of compilation, difference of the simulation, difference of derivatives."""
    past, ends = context.n_past_u, [np.zeros((n, 2)) for n in (context.nu, context.ny)]
    past_u, past_y, u, y = record.u[:past], record.y[:past], record.u[past:], record.y[past:]
    y_hat = model.simulate(past_u[None], past_y[None], u[None])[0]
    window = SimulatedSegment(past_u, past_y, u, y, y_hat=y_hat)
    wide = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    low = lowered(model, past, context.n_past_y, context.nu, context.ny)
    jax.config.update("jax_enable_x64", wide)
    export = ExportModel(
        "delays", "refit", "pipe", low, context.inputs, context.outputs, STEP, *ends
    )
    files = CTarget().print(export).files
    with tempfile.TemporaryDirectory(prefix="asia-delays-") as made:
        for file, data in files.items():
            (Path(made) / file).write_bytes(data)
        compiler, before = c_compiler(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        assert compiler is not None
        compile_c(compiler, ["-std=c99", "-O2", "-c", "model.c"], Path(made), "C")
        seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        answers = CTarget().run(Path(made), [window])
    assert not isinstance(answers, str)
    parity = difference(answers[0].y_hat, [window])
    size = len(files["model.c"])
    return f"{size:8d} B{seconds:6.2f} s{parity:9.1e}{slope_difference(low, window):9.1e}"


def slope_difference(low: LoweredModel, window: SimulatedSegment) -> float:
    """Largest difference of the derivatives of a step from central differences."""
    signals = [*evaluate(low.initial, [window.past_u, window.past_y, window.u[0]]), window.u[0]]
    flat = np.concatenate([np.ravel(signal) for signal in signals])

    def step(values: np.ndarray) -> np.ndarray:
        ends = np.cumsum([signal.size for signal in signals])[:-1]
        parts = zip(np.split(values, ends), signals, strict=True)
        found = evaluate(low.step, [part.reshape(signal.shape) for part, signal in parts])
        return np.concatenate([np.ravel(value) for value in found])

    shifts = 1e-6 * np.eye(len(flat))
    each = [(step(flat + shift) - step(flat - shift)) / 2e-6 for shift in shifts]
    return float(np.abs(derivatives(low.step, signals)[1] - np.stack(each, axis=1)).max())


def fit(
    name: str, samples: int, iterations: int
) -> tuple[greybox.GreyBox, Trajectory, Context, float]:
    """Fit once: the model, its record and problem, and the processor time."""
    signal, output, more = CASES[name]
    rng = np.random.default_rng(0)
    q = np.repeat(rng.uniform(0.4, 1.2, samples // 20 + 1), 20)[:samples]
    s = np.repeat(rng.standard_normal(samples // 7 + 1), 7)[:samples]
    late = int(DEAD / STEP)
    held = np.concatenate([np.repeat(s[:1], late), s[:-late]])
    x = np.zeros(samples)
    for k in range(samples - 1):
        x[k + 1] = x[k] + STEP * 0.1 * (held[k] - x[k])
    y = x + 0.02 * rng.standard_normal(samples)
    physics = Physics(
        ("x",), {"x": f"a*(b*{signal} - x)"}, {**TANK, **more}, observation={"y": output}
    )
    inputs = tuple(map(Signal, ("q", "s", "held")))
    context = Context(inputs, (Signal("y"),), STEP, 10, 10, physics=physics)
    record = Trajectory(np.stack([q, s, held], axis=1), y[:, None], STEP)
    method = LevenbergMarquardt(iterations=iterations, starts=4, tolerance=0.0)
    model = greybox.build(greybox.Config(), context)
    before = time.process_time()
    model = greybox.train(model, [record], context, method)
    return model, record, context, time.process_time() - before


if __name__ == "__main__":
    main()
