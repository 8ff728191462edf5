"""Plants from closed-loop records: direct, two-stage and loop fits against open-loop treatment.

    python benchmarks/models/closed_loop.py [--seeds 0 1 2 3 4] [--samples 1500] [--search 4]

Eight generated plants, one with an integrator and two unstable, each in a loop with an LQG
controller. A binary reference moves the loop, and coloured noise on the output runs through the
controller into the input. Each cell judges the plant under a second, faster controller that it was
not recorded with: error of the noise-free output of the loop for a fresh reference, in percent of
the deviation of the true output, median over the seeds. "u3" means that the loop of the model was
unstable for 3 seeds; an unstable loop counts as an infinite error. `controller` knows the
controller of the records, the other methods do not. `explained` is an open-loop fit to the part of
the input that the reference explains, as [loop] inputs = "explained" gives to every family.
With --search N the columns are a search of N experiments with [loop], whose controller is unknown,
and one without; plants that integrate or are unstable are scored on windows of 50 samples.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

import asia
from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.export.linear import linearize
from asia.models import linear
from asia.problem.feedback import Controller, Loop, explained_inputs

Array = NDArray[np.float64]
System = tuple[Array, Array, Array, Array]

METHODS = ("open loop", "direct", "two_stage", "controller", "explained")


@dataclass(frozen=True)
class Plant:
    """Plant y = G u + v, with v = noise / (1 - colour / z)."""

    name: str
    poles: tuple[complex, ...]
    zeros: tuple[float, ...]
    colour: float
    noise: float
    delay: int = 0

    @property
    def system(self) -> System:
        """A, B, C, D, with a gain of about one."""
        den, num = (np.atleast_1d(np.poly(p)).real for p in (self.poles, self.zeros))
        n = len(den) - 1
        a = np.eye(n, k=-1)
        a[0] = -den[1:]
        c = np.concatenate([np.zeros(n - len(num)), num])[None]
        # Size of the response near a tenth of the Nyquist frequency.
        z = np.exp(0.1j * np.pi)
        c = c / abs(np.polyval(num, z) / np.polyval(den, z))
        found = a, np.eye(n, 1), c, np.zeros((1, 1))
        for _ in range(self.delay):
            a, b, c, d = found
            a = np.block([[a, b], [np.zeros((1, len(a) + 1))]])
            b = np.eye(len(a), 1, k=-(len(a) - 1))
            found = a, b, np.hstack([c, [[0.0]]]), d
        return found


PLANTS = (
    Plant("lag", (0.9,), (), 0.8, 0.3),
    Plant("two lags, delay 2", (0.95, 0.8), (0.3,), 0.9, 0.3, 2),
    Plant("resonance", (0.9 + 0.3j, 0.9 - 0.3j), (0.5,), 0.7, 0.3),
    Plant("non-minimum phase", (0.85, 0.7), (1.3,), 0.9, 0.3),
    Plant("three lags", (0.95, 0.85, 0.6), (0.2, -0.4), 0.95, 0.3),
    Plant("integrator", (1.0, 0.7), (0.2,), 0.9, 0.3),
    Plant("unstable", (1.08, 0.7), (0.1,), 0.8, 0.3),
    Plant("unstable resonance", (1.02 + 0.25j, 1.02 - 0.25j, 0.6), (0.4, -0.2), 0.8, 0.3),
)


def lqg(plant: System, effort: float) -> System:
    """Controller u = C e from the linear-quadratic regulator and a Kalman filter."""
    a, b, c, _ = plant
    p = solve_discrete_are(a, b, c.T @ c, effort * np.eye(1))
    k = np.linalg.solve(b.T @ p @ b + effort * np.eye(1), b.T @ p @ a)
    s = solve_discrete_are(a.T, c.T, b @ b.T, 0.1 * np.eye(1))
    gain = a @ s @ c.T @ np.linalg.inv(c @ s @ c.T + 0.1 * np.eye(1))
    # x+ = A x + B u + gain (y - C x), u = -K x; driven by e = -y it is u = C e.
    return a - b @ k - gain @ c, gain, k, np.zeros((1, 1))


def closed_loop(plant: System, controller: System) -> System:
    """System from [r, v] to [y, u]; the controller has no direct part."""
    a, b, c, d = plant
    ac, bc, cc, _ = controller
    u = np.hstack([np.zeros((1, len(a))), cc])
    y = np.hstack([c, d @ cc])
    whole = np.vstack([np.hstack([a, b @ cc]), np.hstack([np.zeros((len(ac), len(a))), ac])])
    whole[len(a) :] -= bc @ y
    driven = np.vstack([np.zeros((len(a), 2)), bc @ np.array([[1.0, -1.0]])])
    return whole, driven, np.vstack([y, u]), np.array([[0.0, 1.0], [0.0, 0.0]])


def simulate(system: System, inputs: Array) -> Array:
    """Outputs from rest."""
    a, b, c, d = system
    x, found = np.zeros(len(a)), np.empty((len(inputs), len(c)))
    for k, now in enumerate(inputs):
        found[k] = c @ x + d @ now
        x = a @ x + b @ now
    return found


def binary(samples: int, rng: np.random.Generator) -> Array:
    """Random levels of -1 and 1, each held for 5 to 25 samples."""
    parts = [np.full(rng.integers(5, 26), rng.choice([-1.0, 1.0])) for _ in range(samples // 5)]
    return np.concatenate(parts)[:samples]


def record(plant: Plant, samples: int, seed: int) -> tuple[Trajectory, System]:
    """Record in the loop with the first controller."""
    rng, system = np.random.default_rng(seed), plant.system
    controller, r = lqg(system, 1.0), binary(samples, rng)
    loop = closed_loop(system, controller)
    spread = simulate(loop, np.stack([r, np.zeros(samples)], axis=1))[:, 0].std()
    noise = rng.standard_normal(samples)
    for k in range(1, samples):
        noise[k] += plant.colour * noise[k - 1]
    noise *= plant.noise * spread / noise.std()
    y, u = simulate(loop, np.stack([r, noise], axis=1)).T
    return Trajectory(u, y, 1.0, "loop", reference=r[:, None]), controller


def error_under(plant: Plant, found: System) -> float:
    """Error in percent under the second controller; infinite where the loop is unstable."""
    controller = lqg(plant.system, 0.2)
    inputs = np.stack([binary(1000, np.random.default_rng(1000)), np.zeros(1000)], axis=1)
    loop = closed_loop(found, controller)
    if abs(np.linalg.eigvals(loop[0])).max() >= 1.0:
        return float("inf")
    truth = simulate(closed_loop(plant.system, controller), inputs)[:, 0]
    return float(100.0 * (simulate(loop, inputs)[:, 0] - truth).std() / truth.std())


def fitted(plant: Plant, samples: int, seed: int, method: str) -> System:
    """Matrices in physical units of the model that a method fits."""
    measured, controller = record(plant, samples, seed)
    rows = [tuple(tuple(row) for row in part.tolist()) for part in controller]
    loop = Loop(reference=(Signal("r"),), controller=Controller((), (), *rows))
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 20, 20, loop=loop)
    if method == "explained":
        measured = replace(measured, u=explained_inputs([measured])[0])
    option = {"open loop": None, "explained": None}.get(method, method)
    config = linear.Config(loop=option, delay=None)
    model = linear.build(config, context)
    model = linear.train(model, [measured], context)
    assert model.fitted is not None
    s, scaling = model.fitted.system, model.fitted.scaling
    ratio = scaling.y_std[:, None] / scaling.u_std
    found = s.a, s.b, s.c * ratio, s.d * ratio
    for _ in range(model.fitted.delay):
        a, b, c, d = found
        # The input is held for one more sample in a further state.
        a = np.block([[a, b], [np.zeros((1, len(a) + 1))]])
        found = a, np.eye(len(a), 1, k=-(len(a) - 1)), np.hstack([c, d]), np.zeros((1, 1))
    return found


def searched(plant: Plant, samples: int, seed: int, experiments: int, *, declared: bool) -> System:
    """Matrices of the model that a search with or without [loop] names."""
    measured, _ = record(plant, samples, seed)
    assert measured.reference is not None
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        table = np.hstack([measured.u, measured.y, measured.reference])
        np.savetxt(root / "loop.csv", table, delimiter=",", header="u,y,r", comments="")
        windows = max(abs(p) for p in plant.poles) >= 1.0
        (root / "problem.toml").write_text(
            'name = "loop"\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
            '[data]\ntrain = ["loop.csv"]\n[protocol]\npast_inputs = 20\npast_outputs = 20\n'
            + ('kind = "windows"\nhorizon = 50\n' if windows else "")
            + ('[loop]\nreference = "r"\n' if declared else "")
        )
        run = asia.run(root, experiments=experiments, runs=root / "runs")
        (point,) = linearize(run).points
    return point.model.a, point.model.b, point.model.c, point.model.d


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--search", type=int, default=0)
    parser.add_argument("--plants", nargs="+", default=[p.name for p in PLANTS])
    options = parser.parse_args()
    methods = ("with [loop]", "without") if options.search else METHODS
    print(f"| plant | {' | '.join(methods)} | seconds a fit |")
    print("|---|" + "---|" * (len(methods) + 1))
    for plant in (p for p in PLANTS if p.name in options.plants):
        begin, cells = time.monotonic(), list[str]()
        for method in methods:
            errors: list[float] = []
            for seed in options.seeds:
                try:
                    if options.search:
                        found = searched(
                            plant, options.samples, seed, options.search,
                            declared=method == methods[0],
                        )  # fmt: skip
                    else:
                        found = fitted(plant, options.samples, seed, method)
                except UserError as error:
                    print(f"{plant.name}, {method}, seed {seed}: {error}")
                    errors.append(float("inf"))
                    continue
                errors.append(error_under(plant, found))
            bad = sum(np.isinf(errors))
            cells.append(f"{statistics.median(errors):.1f}" + (f" u{bad}" if bad else ""))
        seconds = (time.monotonic() - begin) / (len(methods) * len(options.seeds))
        print(f"| {plant.name} | {' | '.join(cells)} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
