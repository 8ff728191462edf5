"""How soon does a monitor report a parameter that drifts by 20 %, and how often does it err?

Four generated systems with their equations, fitted by a grey box on two folds and on all of a
training record. The monitor is the printed C, which agrees with the Python monitor to 1e-9. Two
monitors run on each record: one of the states alone, and one that also estimates the parameter.

    python benchmarks/models/monitor.py [--samples 100000] [--repeats 20] [--systems tanks,...]
"""

from __future__ import annotations

import argparse
import math
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from asia.candidate import Context
from asia.control.observer import HeldOut, Observer, TimeVarying, make_observer
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Signal, Trajectory
from asia.export.model import ExportModel
from asia.export.targets.c import c_compiler, observed, observer_files
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered
from asia.models import greybox
from asia.models.methods import LevenbergMarquardt
from asia.problem.physics import Bounds, ParameterRange, Physics

PAST, TRAINING, NOISE = 10, 2000, 0.05
RATE, MEMORY = 1e-4, 500
# Samples before a drift begins.
BEFORE = 2000


@dataclass(frozen=True)
class System:
    """x' = rate(x, u, p), y = first state or the last; p is the parameter that drifts."""

    rate: Callable[[Array, Array, float], Sequence[Array]]
    dynamics: dict[str, str]
    parameters: dict[str, float]
    drifting: str
    step: float
    low: float
    high: float
    start: tuple[float, ...]
    output: int = 0
    least: float | None = None


SYSTEMS = {
    "tanks": System(
        lambda x, u, p: (
            p * u - 0.05 * np.sqrt(x[0]), 0.05 * (np.sqrt(x[0]) - np.sqrt(x[1])),
        ),
        {"a": "k4*u - k1*sqrt(a)", "b": "k2*(sqrt(a) - sqrt(b))"},
        {"k1": 0.05, "k2": 0.05, "k4": 0.06}, "k4", 4.0, 1.0, 3.0, (4.0, 4.0), 1, 1e-6,
    ),
    "spring": System(
        lambda x, u, p: (x[1], -p * x[0] - 0.6 * x[1] - 1.5 * x[0] ** 3 + 2.0 * u),
        {"x": "v", "v": "-k*x - c*v - d*x**3 + b*u"},
        {"k": 4.0, "c": 0.6, "d": 1.5, "b": 2.0}, "k", 0.1, -3.0, 3.0, (0.0, 0.0),
    ),
    "oven": System(
        lambda x, u, p: (p * u - 0.02 * x[0] - 0.4 * ((1 + 0.2 * x[0]) ** 4 - 1) * 0.02,),
        {"temp": "q*u - h*temp - r*((1 + 0.2*temp)**4 - 1)"},
        {"q": 0.1, "h": 0.02, "r": 0.008}, "q", 5.0, 0.0, 2.0, (1.0,),
    ),
    "drive": System(
        lambda x, u, p: (2.0 * u - p * x[0] - 0.5 * np.tanh(5.0 * x[0]),),
        {"w": "b*u - f*w - m*tanh(5*w)"},
        {"b": 2.0, "f": 0.8, "m": 0.5}, "f", 0.05, -2.0, 2.0, (0.0,),
    ),
}  # fmt: skip


def simulated(
    system: System,
    rng: np.random.Generator,
    records: int,
    samples: int,
    drift: Array | None = None,
) -> tuple[Array, Array]:
    """Inputs and outputs (records, samples, 1) without noise; drift: factors (samples,) of the
    parameter."""
    rows: list[Array] = []
    for _ in range(records):
        lengths = rng.integers(5, 60, samples // 5)
        rows.append(np.repeat(rng.uniform(system.low, system.high, len(lengths)), lengths))
    u, h = np.stack([row[:samples] for row in rows]), system.step / 4
    x = np.repeat(np.array(system.start)[:, None], records, axis=1)
    factors = np.ones(samples) if drift is None else drift
    y = np.empty((records, samples))

    def rate(x: Array, k: int) -> Array:
        p = system.parameters[system.drifting] * factors[k]
        return np.stack(system.rate(x, u[:, k], p))

    for k in range(samples):
        y[:, k] = x[system.output]
        for _ in range(4):
            k1 = rate(x, k)
            k2 = rate(x + 0.5 * h * k1, k)
            k3 = rate(x + 0.5 * h * k2, k)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + h * k3, k))
            x = x if system.least is None else np.maximum(x, system.least)
    return u[..., None], y[..., None]


def fitted(system: System, train: Sequence[Trajectory], context: Context) -> LoweredModel:
    """A grey box whose last state is the drifting parameter."""
    model = greybox.build(greybox.Config(), context)
    model = greybox.train(model, train, context, LevenbergMarquardt(iterations=40, starts=4))
    return lowered(model.with_parameters((system.drifting,)), PAST, PAST, 1, 1)


def observers(system: System, noise: float, rng: np.random.Generator) -> tuple[Observer, Observer]:
    """Observer of the states, and of states and parameter, from a training record."""
    (u,), (y,) = simulated(system, rng, 1, TRAINING)
    y = y + noise * rng.normal(size=y.shape)
    names = list(system.dynamics)
    physics = Physics(
        states=tuple(names), dynamics=system.dynamics,
        parameters={k: ParameterRange(v / 4, v * 4) for k, v in system.parameters.items()},
        observation={"y": names[system.output]},
        bounds={} if system.least is None else {n: Bounds(min=0.0) for n in names},
    )  # fmt: skip
    context = Context((Signal("u"),), (Signal("y"),), system.step, PAST, PAST, physics=physics)
    half = TRAINING // 2
    parts = [Trajectory(u[s], y[s], system.step, "train") for s in (slice(half), slice(half, None))]
    whole = Trajectory(u, y, system.step, "train")
    own = fitted(system, [whole], context)
    folds = [fitted(system, [parts[1]], context), fitted(system, [parts[0]], context)]
    held = [
        HeldOut(k, part.u[:PAST], part.y[:PAST], part.u[PAST:], part.y[PAST:])
        for k, part in enumerate(parts)
    ]
    nominal = float(own.initial.constants[-1].reshape(-1)[0])
    nominal = system.parameters[system.drifting] if not nominal > 0 else nominal
    found: list[Observer] = []
    for spread in (0.0, 0.2):
        one = TimeVarying(system.drifting, nominal, spread * nominal, 0.05 * nominal, 20 * nominal)
        forgetting = math.exp(-1.0 / MEMORY)
        observer, _ = make_observer(own, folds, held, u.var(axis=0), [one], [], forgetting, RATE)
        found.append(observer)
    return found[0], found[1]


class Printed:
    """Observer as C."""

    def __init__(self, observer: Observer, folder: Path) -> None:
        one = np.zeros((1, 2))
        signals = (Signal("u"),), (Signal("y"),)
        model = ExportModel("run", "refit", "system", observer.low, *signals, 1.0, one, one)
        self.observer, self.folder = observer, folder
        folder.mkdir()
        for name, data in observer_files(model, observer).items():
            (folder / name).write_bytes(data)

    def run(self, records: Sequence[tuple[Array, Array]]) -> list[tuple[Array, Array, Array]]:
        """NIS, the sample since which the model is not valid or -1, and the parameter."""
        compiler = c_compiler()
        assert compiler is not None
        windows = [
            SimulatedSegment(u[:PAST], y[:PAST], u[PAST:], y[PAST:], y_hat=y[PAST:])
            for u, y in records
        ]
        found, _ = observed(compiler, self.folder, windows, 6)
        return [(one[:, 1], one[:, -1], one[:, 3]) for one in found]


def main() -> None:
    """Print a row for each system and monitor."""
    from scipy.special import chdtri

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    low, high = float(chdtri(1, 0.975)), float(chdtri(1, 0.025))
    print("| system | monitor | NIS inside 95 % | false alarms | step: found, median delay "
          "(samples) | ramp: found, median delay | parameter at the end (true 1.2) |")  # fmt: skip
    print("|---|---|---|---|---|---|---|")
    for name in options.systems.split(","):
        system, begin = SYSTEMS[name], time.perf_counter()
        rng = np.random.default_rng(1)
        noise = NOISE * float(simulated(system, rng, 1, TRAINING)[1].std())

        def recorded(
            records: int, samples: int, drift: Array | None = None, noise: float = noise,
            system: System = system, rng: np.random.Generator = rng,
        ) -> list[tuple[Array, Array]]:  # fmt: skip
            u, y = simulated(system, rng, records, samples, drift)
            return list(zip(u, y + noise * rng.normal(size=y.shape), strict=True))

        made = observers(system, noise, rng)
        with tempfile.TemporaryDirectory() as folder:
            printed = [Printed(one, Path(folder) / str(k)) for k, one in enumerate(made)]
            quiet = recorded(options.samples // 5000, 5000 + PAST)
            kinds: list[list[tuple[Array, Array]]] = []
            for length in (1, 1000):
                factors = 1.0 + 0.2 * np.clip((np.arange(BEFORE + 3000) - BEFORE) / length, 0, 1)
                kinds.append(recorded(options.repeats, len(factors), factors))
            for kind, one in zip(("states", "states and parameter"), printed, strict=True):
                each = one.run(quiet)
                nis = np.concatenate([part[0] for part in each])
                alarms = sum(
                    int(((since[1:] >= 0) & (since[:-1] < 0)).sum()) for _, since, _ in each
                )
                inside = float(np.mean((nis > low) & (nis < high)))
                columns: list[str] = []
                values: list[float] = []
                for records in kinds:
                    delays: list[int] = []
                    for _, since, parameter in one.run(records):
                        values.append(parameter[-1] / one.observer.parameters[0].nominal)
                        raised = np.flatnonzero(since >= 0)
                        raised = raised[raised >= BEFORE - PAST]
                        if len(raised):
                            delays.append(int(raised[0]) - (BEFORE - PAST))
                    delay = f"{statistics.median(delays):.0f}" if delays else "none"
                    columns.append(f"{len(delays)} of {len(records)}, {delay}")
                end = f"{statistics.mean(values):.3f}" if kind != "states" else ""
                print(f"| {name} | {kind} | {inside:.1%} | {alarms} in {len(nis)} | {columns[0]} | "
                      f"{columns[1]} | {end} |", flush=True)  # fmt: skip
        print(f"<!-- {name}: {time.perf_counter() - begin:.0f} s -->", flush=True)


if __name__ == "__main__":
    main()
