"""Are order, modes and a hidden delay of frequency responses found?

Flexible structures with two to four lightly damped modes and a delay, with 2 % noise of known
variance; and the arm of a CD player (two inputs, two outputs), whose response is estimated from its
training record by local polynomials. With --joint: is a linear model better with a response beside
a short and noisy record? The slow input hardly excites the second mode, and the response begins
above the first one.

    python benchmarks/models/frequency.py [--systems 20] [--joint 8] [--cd FOLDER]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import lsim

from asia.candidate import Context
from asia.data.frequency import FrequencyRecord, frequency_response
from asia.data.trajectory import Signal, Trajectory
from asia.lowering.linear import LinearModel
from asia.models import linear
from asia.models.frequency_response import delayed_response, fit_frequency_response
from asia.problem.load import load_problem


def structure(rng: np.random.Generator) -> tuple[FrequencyRecord, list[float], float]:
    """A noisy response, its mode frequencies in Hz and its delay in s."""
    count, f = int(rng.integers(2, 5)), np.geomspace(0.5, 60.0, 300)
    modes = np.exp(np.linspace(np.log(2.0), np.log(30.0), count) + rng.uniform(-0.2, 0.2, count))
    s, g, delay = 2j * np.pi * f, np.zeros(300, np.complex128), float(rng.uniform(0.002, 0.03))
    for frequency in modes:
        w, size = 2 * np.pi * frequency, rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0])
        g += size * w * w / (s * s + 2 * rng.uniform(0.004, 0.02) * w * s + w * w)
    g = (g * np.exp(-s * delay))[:, None, None]
    deviation = 0.02 * np.abs(g) + 0.002
    noise = (rng.normal(size=g.shape) + 1j * rng.normal(size=g.shape)) / np.sqrt(2.0)
    signals = (Signal("force"),), (Signal("tip"),)
    record = FrequencyRecord("structure", f, g + deviation * noise, deviation**2, 0.0, *signals)
    return record, modes.tolist(), delay


STEP, FINE = 0.05, 10


def two_modes(rng: np.random.Generator) -> LinearModel:
    """Two modes, at about 1 and 6 Hz, in continuous time."""
    a, b, c = np.zeros((4, 4)), np.zeros((4, 1)), np.array([[1.0, 0.0, 1.0, 0.0]])
    for k, (f, damping, gain) in enumerate(((1.0, 0.05, 1.0), (6.0, 0.02, 0.5))):
        w, i = 2 * np.pi * f * rng.uniform(0.9, 1.1), 2 * k
        a[i : i + 2, i : i + 2] = [[0.0, w], [-w, -2 * damping * w]]
        b[i + 1, 0] = w * gain * rng.choice([-1.0, 1.0])
    return LinearModel(a, b, c, np.zeros((1, 1)), 0.0, np.zeros(1), np.zeros(1))


def simulated(model: LinearModel, u: np.ndarray, late: int) -> np.ndarray:
    """Outputs for held inputs that arrive `late` tenths of a sample later."""
    held = np.concatenate([np.zeros(late), np.repeat(u, FINE)])[: len(u) * FINE]
    system, t = (model.a, model.b, model.c, model.d), STEP / FINE * np.arange(len(held))
    return lsim(system, held, t, interp=False)[1][::FINE]


def joint(seed: int) -> list[float]:
    """Errors on white inputs, in standard deviations: of the record alone, and with the response,
    its variance known and unknown."""
    rng = np.random.default_rng(seed)
    model, late = two_modes(rng), int(rng.integers(0, 25))
    u = np.repeat(rng.normal(size=20), 15)
    y = simulated(model, u, late)
    y += 0.2 * y.std() * rng.normal(size=len(y))
    f, signals = np.geomspace(2.5, 10.0, 60), ((Signal("u"),), (Signal("y"),))
    g = delayed_response(model, late * STEP / FINE, f)
    deviation = 0.02 * np.abs(g) + 0.002
    g = g + deviation * (rng.normal(size=g.shape) + 1j * rng.normal(size=g.shape)) / np.sqrt(2.0)
    known = FrequencyRecord("both", f, g, deviation**2, 0.0, *signals)
    test = rng.normal(size=600)
    true, found = simulated(model, test, late), list[float]()
    for responses in ((), (known,), (replace(known, variance=None),)):
        context = Context(*signals, STEP, 8, 8, responses=responses)
        trajectory = Trajectory(u[:, None], y[:, None], STEP, "one")
        config = linear.Config(delay=None)
        fitted = linear.train(linear.build(config, context), [trajectory], context)
        past = test[None, :8, None], true[None, :8, None]
        apart = fitted.simulate(*past, test[None, 8:, None])[0, :, 0] - true[8:]
        found.append(float(apart.std() / true.std()))
    return found


def main() -> None:
    """Print one row for the structures, one for joint fits and one for the CD player."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", type=int, default=20)
    parser.add_argument("--cd", type=Path, help="folder of the problem cd_arm")
    parser.add_argument("--joint", type=int, default=8)
    options = parser.parse_args()
    begin, right, inside, apart, modes_off = time.process_time(), 0, 0, list[float](), list[float]()
    for seed in range(options.systems):
        record, modes, delay = structure(np.random.default_rng(seed))
        found = fit_frequency_response(record)
        right += found.model.order == 2 * len(modes)
        inside += found.delay_band[0] <= delay <= found.delay_band[1]
        apart.append(abs(found.delay - delay) / delay)
        known = np.array([frequency for _, frequency, _, _ in found.model.modes()])
        modes_off += [float(np.abs(known / one - 1.0).min()) for one in modes]
    seconds = (time.process_time() - begin) / options.systems
    print("| structures | right order | delay in its 95 % interval | median error of the delay | "
          "95 % of the modes within | seconds each |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    print(f"| {options.systems} | {right} | {inside} | {np.median(apart):.1%} | "
          f"{np.quantile(modes_off, 0.95):.2%} | {seconds:.1f} |")  # fmt: skip
    errors = np.array([joint(seed) for seed in range(options.joint)])
    print("\n| joint fits | error of the record alone | with the response | variance unknown |")
    print("|---|---|---|---|")
    each = " | ".join(f"{np.median(one):.4f} (most {one.max():.4f})" for one in errors.T)
    print(f"| {options.joint} | {each} |")
    if options.cd is not None:
        problem = load_problem(options.cd)
        parts = [frequency_response(problem.train, k, None) for k in range(len(problem.outputs))]
        known = [one for one in parts if one is not None]
        response = np.stack([one.gain for one in known], axis=1)
        every = max(len(response) // 400, 1)
        record = FrequencyRecord(
            "cd_arm", known[0].frequency[::every], response[::every], None, problem.sampling_time,
            problem.inputs, problem.outputs,
        )  # fmt: skip
        found = fit_frequency_response(record)
        print(f"\nCD player: {len(record.frequency)} frequencies, order {found.model.order}, delay "
              f"{found.delay / problem.sampling_time:.2f} samples, relative error "
              f"{found.error:.1%}, held out {found.held_out:.1%}")  # fmt: skip


if __name__ == "__main__":
    main()
