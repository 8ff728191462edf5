"""Do statistics of records err as rarely as they say?

Random plants with up to three inputs of different order in coloured noise: coverage of the 95 %
intervals of process-model parameters, and delays within one sample, with the numbers of lags chosen
and given. Open-loop files with five kinds of inputs: alarms of feedback and drift. Closed-loop
files: feedback that is found. Linear files: alarms of a dependence on a level. Files with a delay
and a time constant that go as one over a flow, and with a gain that doubles: what is found.

    python benchmarks/models/record_statistics.py [--plants 200] [--files 500] [--loops 100]
        [--linear 200] [--levels 50] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Literal, get_args

import numpy as np
from scipy.signal import lfilter

from asia.analysis.process import ProcessStructure, fit_process
from asia.data import Array, Trajectory
from asia.data.level_responses import level_responses
from asia.data.relations import Transport
from asia.data.statistics import FALSE_ALARMS, delays, drifts, feedback
from asia.errors import UserError
from asia.lowering.linear import ProcessModel

Quantity = Literal["gain", "delay", "time_constant"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
KINDS = ("steps", "prbs", "multisine", "walk", "weather")


def signal(rng: np.random.Generator, kind: str, samples: int) -> Array:
    """An input of a kind, without others in it."""
    time = np.arange(samples)
    if kind == "steps":
        hold = int(rng.integers(15, 60))
        return np.repeat(rng.uniform(-1.0, 1.0, samples // hold + 1), hold)[:samples]
    if kind == "prbs":
        hold = int(rng.integers(3, 12))
        return np.repeat(rng.choice([-1.0, 1.0], samples // hold + 1), hold)[:samples]
    if kind == "multisine":
        phases = rng.uniform(0.0, 2.0 * np.pi, 29)
        waves = [np.cos(2.0 * np.pi * k * time / samples + p) for k, p in enumerate(phases, 1)]
        return np.sum(waves, axis=0)
    if kind == "walk":
        return np.cumsum(rng.normal(size=samples))
    slow = np.asarray(lfilter([0.1], [1.0, -0.97], rng.normal(size=samples)))
    return np.sin(2.0 * np.pi * time / 96.0 + rng.uniform(0.0, 1.0)) + slow


def noise(rng: np.random.Generator, samples: int) -> Array:
    """Autoregressive noise of deviation 1."""
    made = np.asarray(lfilter([1.0], [1.0, -rng.uniform(0.0, 0.9)], rng.normal(size=samples)))
    return made / made.std()


def plant(rng: np.random.Generator, samples: int) -> tuple[Trajectory, list[ProcessModel]]:
    """Up to three inputs, each with its own lags and delay, from rest, in coloured noise."""
    models: list[ProcessModel] = []
    inputs: list[Array] = []
    y = np.zeros(samples)
    time = np.arange(float(samples))
    for _ in range(int(rng.integers(1, 4))):
        count, slow = int(rng.integers(1, 3)), rng.uniform(4.0, 20.0)
        lags = (slow, slow * rng.uniform(0.25, 0.7))[:count]
        gain = rng.uniform(0.5, 2.0) * rng.choice([-1.0, 1.0])
        model = ProcessModel(gain, lags, 0.0, rng.uniform(0.0, 15.0), False, 0.0)
        u = signal(rng, "prbs" if rng.random() < 0.5 else "steps", samples)
        u[:30] = 0.0
        moves = np.diff(u, prepend=0.0)
        for k in np.flatnonzero(moves):
            y[k:] += moves[k] * model.step(time[: samples - k])
        models.append(model)
        inputs.append(u)
    y += noise(rng, samples) * y.std() * rng.choice([0.03, 0.1, 0.2])
    return Trajectory(np.stack(inputs, axis=1), y[:, None], 1.0, "plant"), models


def open_loop(rng: np.random.Generator, kind: str, samples: int, curved: float = 0.3) -> Trajectory:
    """One or two inputs of a kind, one or two outputs, a share of them nonlinear."""
    inputs: list[Array] = []
    for _ in range(int(rng.integers(1, 3))):
        u = signal(rng, kind, samples)
        inputs.append(u + 0.5 * inputs[0] if kind == "weather" and inputs else u)
    outputs: list[Array] = []
    for _ in range(int(rng.integers(1, 3))):
        y = np.zeros(samples)
        for u in inputs:
            a, b = rng.uniform(0.3, 0.97, 2)
            late = [*np.zeros(int(rng.integers(1, 10))), (1.0 - a) * (1.0 - b)]
            part = np.asarray(lfilter(late, np.convolve([1.0, -a], [1.0, -b]), u))
            y += part / part.std() * rng.uniform(0.5, 2.0) * rng.choice([-1.0, 1.0])
        y += 0.1 * y**2 * (rng.random() < curved)
        outputs.append(y + noise(rng, samples) * y.std() * rng.uniform(0.03, 0.4))
    return Trajectory(np.stack(inputs, axis=1), np.stack(outputs, axis=1), 1.0, kind)


def closed_loop(rng: np.random.Generator, samples: int) -> Trajectory:
    """A proportional-integral controller, with steps of the set point and a disturbance."""
    pole, gain = rng.uniform(0.7, 0.95), rng.uniform(0.2, 0.8)
    target, disturbed = signal(rng, "steps", samples), 0.3 * noise(rng, samples)
    u, y, x, total = np.zeros(samples), np.zeros(samples), 0.0, 0.0
    for k in range(samples):
        y[k] = x + disturbed[k]
        error = target[k] - y[k]
        total += 0.05 * error
        u[k] = gain * error + total + 0.05 * rng.normal()
        x = pole * x + (1.0 - pole) * u[k]
    return Trajectory(u[:, None], y[:, None], 1.0, "loop")


def by_level(rng: np.random.Generator, kind: Quantity, samples: int) -> Trajectory:
    """Flow and load, and an output whose response to the load has a quantity that follows the flow:
    a delay or a time constant as one over it, or a gain that doubles from its lowest value to its
    highest."""
    flow = np.repeat(rng.uniform(0.4, 1.6, samples // 20 + 1), 20)[:samples]
    load = np.repeat(rng.normal(size=samples // 8 + 1), 8)[:samples]
    u = np.column_stack([flow, load])
    size, y = rng.uniform(4.0, 10.0), np.zeros(samples)
    acting = Transport(0, size).carried(u)[:, 1] if kind == "delay" else load
    acting = acting * (0.5 + 0.5 * (flow - 0.4) / 1.2) if kind == "gain" else acting
    for k in range(samples - 1):
        pace = flow[k] if kind == "time_constant" else 1.0
        y[k + 1] = y[k] + (1.0 - np.exp(-2.0 * pace / size)) * (acting[k] - y[k])
    y += noise(rng, samples) * y.std() * rng.choice([0.03, 0.1, 0.2])
    return Trajectory(u, y[:, None], 1.0, kind)


def count_levels(linear: int, levels: int, seed: int) -> None:
    """Print the rates of false alarms and of dependences on a level that are found."""
    alarms = Counter[str]()
    for number in range(linear):
        kind = KINDS[number % len(KINDS)]
        record = open_loop(np.random.default_rng([seed, 4, number]), kind, 1000, 0.0)
        alarms[kind] += bool(level_responses([record]))
    if linear:
        print(f"linear: a response depends on a level in {sum(alarms.values())} of {linear} files, "
              f"{dict(alarms)}")  # fmt: skip
    for kind in QUANTITIES if levels else ():
        shown = right = 0
        powers: list[float] = []
        for number in range(levels):
            found = level_responses(
                [by_level(np.random.default_rng([seed, 5, number]), kind, 1000)]
            )
            shown += bool(found)
            load = [r for r in found if r.input == 1 and (r.of, r.signal) == ("input", 0)]
            quantity = getattr(load[0], kind) if load else None
            if quantity is not None and quantity.changes:
                right += 1
                powers.append(quantity.power)
        mean = float(np.mean(powers)) if powers else np.nan
        print(f"{kind} that follows a flow: dependence found in {shown} of {levels} files, in this "
              f"quantity in {right}; mean power of the flow {mean:.2f}")  # fmt: skip


def count_plants(plants: int, seed: int, *, known: bool) -> None:
    """Print the coverage of intervals and delays.

    Args:
        known: whether the fit is given the true numbers of lags
    """
    tried, held = Counter[str](), Counter[str]()
    near = pairs = withheld = structures = 0
    for number in range(plants):
        record, models = plant(np.random.default_rng([seed, 1, number]), 800)
        forms = [ProcessStructure(len(true.lags)) for true in models] if known else None
        try:
            found = fit_process([record], 0, forms)
        except UserError:
            withheld += len(models)
            continue
        late = found.first if known else [d and d.lag for d in delays([record])[0]]
        for true, model, values, first in zip(
            models, found.models, found.parameters, late, strict=True
        ):
            pairs += 1
            near += first is not None and abs(first - int(np.floor(true.delay)) - 1) <= 1
            withheld += model is None
            if model is None or len(model.lags) != len(true.lags) or model.zero or model.integrator:
                continue
            structures += 1
            truth = {"gain": true.gain, "delay": true.delay}
            truth |= {f"time constant {k}": lag for k, lag in enumerate(true.lags, 1)}
            for p in values:
                tried[p.name] += 1
                held[p.name] += p.low <= truth[p.name] <= p.high
    print("numbers of lags given" if known else "numbers of lags chosen")
    whole = sum(held.values()) / max(sum(tried.values()), 1)
    print(f"  delays within one sample: {near} of {pairs} pairs ({near / max(pairs, 1):.1%})")
    print(f"  intervals with the truth: {whole:.1%} of {sum(tried.values())} in {structures} "
          f"pairs with the true structure; {withheld} withheld")  # fmt: skip
    for name in sorted(tried):
        print(f"    {name}: {held[name]} of {tried[name]} ({held[name] / tried[name]:.1%})")


def main() -> None:
    parser = argparse.ArgumentParser()
    defaults = {"plants": 200, "files": 500, "loops": 100, "linear": 200, "levels": 50, "seed": 0}
    for name, default in defaults.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    start = time.process_time()
    count_levels(given.linear, given.levels, given.seed)
    for given_structure in (False, True) if given.plants else ():
        count_plants(given.plants, given.seed, known=given_structure)
    alarms, drifting = Counter[str](), Counter[str]()
    for number in range(given.files):
        kind = KINDS[number % len(KINDS)]
        record = open_loop(np.random.default_rng([given.seed, 2, number]), kind, 1000)
        alarms[kind] += bool((feedback([record]) < FALSE_ALARMS).any())
        drifting[kind] += any(drifts([record]))
    if given.files:
        print(f"open loop: feedback alarms in {sum(alarms.values())}, drift alarms in "
              f"{sum(drifting.values())} of {given.files} files; {dict(alarms)}; "
              f"{dict(drifting)}")  # fmt: skip
    hits = 0
    for number in range(given.loops):
        record = closed_loop(np.random.default_rng([given.seed, 3, number]), 1000)
        hits += bool((feedback([record]) < FALSE_ALARMS).any())
    if given.loops:
        print(f"closed loop: feedback found in {hits} of {given.loops} files")
    print(f"{time.process_time() - start:.0f} s of one core")


if __name__ == "__main__":
    main()
