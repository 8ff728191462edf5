"""Calibrated simulators: coverage of the 95 % intervals, and the time that a fit takes.

    python benchmarks/models/simulators.py [--repeats 20]

Two tanks as a Python function with three parameters and two initial states, the same rounded to 2 %
of its range (no useful gradient), and a heater that is an FMU of ASIA's own export, with a constant
disturbance as its parameter. Two records of 300 samples each, noise 2 % of the output.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.models import simulator
from asia.models.methods import LevenbergMarquardt
from asia.problem.plant import Plant, Unknown

TANKS = """
def simulate(u, params, x0, dt):
    k1, k2, k3 = params["k1"], params["k2"], params["k3"]
    a, b, y = x0["h1"], x0["h2"], []
    for (pump,) in u.tolist():
        y.append(b)
        for _ in range(2):
            flow = k1 * max(a, 0.0) ** 0.5
            a = max(a + dt / 2 * (k2 * pump - flow), 0.0)
            b = max(b + dt / 2 * (flow - k3 * max(b, 0.0) ** 0.5), 0.0)
    return y
"""
ROUNDED = TANKS.replace("return y", "return [round(v / 0.05) * 0.05 for v in y]")
TRUTH = {"k1": 0.16, "k2": 0.12, "k3": 0.14}
RANGES = {name: Unknown(0.01, 1.0) for name in TRUTH}
START = {"h1": Unknown(0.0, 8.0), "h2": Unknown(0.0, 8.0)}
CONTEXT = Context((Signal("pump"),), (Signal("level"),), 1.0, 10, 10)


def exported() -> tuple[Plant, dict[str, float], Context] | None:
    """An FMU by ASIA of a linear model with two inputs, of which the second is a parameter."""
    from asia.export.model import ExportModel
    from asia.export.targets.fmu import FmuTarget
    from asia.lowering.trace import lowered_bytes
    from asia.lowering.wire import unpack
    from asia.models import linear
    from asia.models._linear.system import LinearSystem
    from asia.models._numerics.encoder import affine
    from asia.models._numerics.scaling import Scaling

    target = FmuTarget()
    if target.missing():
        return None
    system = LinearSystem(
        np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0, 0.1], [0.5, 0.0]]),
        np.array([[1.0, 0.0]]), np.zeros((1, 2)), np.zeros(1),
    )  # fmt: skip
    scaling = Scaling(np.zeros(2), np.ones(2), np.zeros(1), np.ones(1))
    encoder = affine(np.eye(6, 2), np.zeros(2))
    fitted = linear.FittedLinear(system, encoder, 0, scaling)
    lowered = lowered_bytes(linear.LinearStateSpace(linear.Config(), fitted), 2, 2, 2, 1)
    inputs, outputs = (Signal("heat"), Signal("ambient")), (Signal("level"),)
    ranges = np.array([[-1.0, 1.0]] * 2)
    model = ExportModel(
        "run", "model", "heater", unpack(lowered), inputs, outputs, 1.0, ranges, ranges[:1]
    )
    files: Any = target.print(model).files
    parameters = {"ambient": Unknown(-3.0, 3.0)}
    plant = Plant(source="model.fmu", parameters=parameters, code=files["model_fmi2.fmu"])
    plant.unpack()
    return plant, {"ambient": 0.8}, replace(CONTEXT, inputs=(Signal("heat"),))


def records(model: simulator.Simulator, truth: dict[str, float], random: Any) -> list[Trajectory]:
    """Two records by the simulator itself, with noise."""

    def place(value: float, span: Unknown) -> float:
        if span.min > 0:
            return float(np.log(value / span.min) / np.log(span.max / span.min))
        return (value - span.min) / (span.max - span.min)

    z = np.array([place(truth[name], span) for name, span in model.plant.parameters.items()])
    found: list[Trajectory] = []
    for name in ("one", "two"):
        u = np.repeat(random.uniform(0.5, 3.0, 30), 10)[:, None]
        y = model.run(u, z, random.uniform(0.1, 0.6, len(model.plant.initial)))
        y += 0.02 * y.std() * random.normal(size=y.shape)
        found.append(Trajectory(u, y, 1.0, name))
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    repeats = parser.parse_args().repeats

    def tanks(code: str) -> Plant:
        return Plant(source="t.py:simulate", parameters=RANGES, initial=START, code=code.encode())

    cases: dict[str, tuple[Plant, dict[str, float], Context] | None] = {
        "tanks": (tanks(TANKS), TRUTH, CONTEXT),
        "tanks, rounded": (tanks(ROUNDED), TRUTH, CONTEXT),
        "FMU by ASIA": exported(),
    }
    headings = ("inside", "error", "width", "gradient", "seconds")
    print(f"{'simulator':16} {' '.join(f'{h:>8}' for h in headings)}")
    for title, case in cases.items():
        if case is None:
            continue
        plant, truth, context = case
        inside: list[bool] = []
        errors: list[float] = []
        widths: list[float] = []
        steps: list[bool] = []
        begin = time.perf_counter()
        for seed in range(repeats):
            random = np.random.default_rng(seed)
            known = replace(context, plant=plant, seed=seed)
            model = simulator.build(simulator.Config(), known)
            data = records(model, truth, random)
            method = LevenbergMarquardt(iterations=20, starts=2)
            model = simulator.train(model, data, known, method)
            assert model.fitted is not None
            steps.append(model.fitted.reliable)
            for name, value in model.parameters().items():
                errors.append(abs(value / truth[name] - 1))
            if model.fitted.reliable:
                for one in model.estimates(data, known).parameters:
                    inside.append(one.low <= truth[one.name] <= one.high)
                    widths.append((one.high - one.low) / truth[one.name])
        seconds = (time.perf_counter() - begin) / repeats
        row = ["       -", f"{np.median(errors):8.2%}", "       -"]
        if inside:
            row = [f"{np.mean(inside):8.0%}", row[1], f"{np.median(widths):8.2%}"]
        print(f"{title:16} {' '.join(row)} {np.mean(steps):8.0%} {seconds:8.1f}", flush=True)


if __name__ == "__main__":
    main()
