"""Eight generated plants like those of a laboratory, as problem directories for `zoo.py`.

A positioning drive in a loop, a heat exchanger with transport, a flexible arm with two modes,
coupled drives whose speed is measured without sign, a wing near flutter, a ball on a beam in a
loop, a soft arm with three inputs and two outputs, and a two-mass drive with a limited torque. Each
has friction, transport, a limit or stiffness that no linear model has, and noise of about 1 % of
the output.

    python benchmarks/searches/plants.py --out plants --seed 0
    python benchmarks/zoo.py --zoo plants --systems flexible_arm ball_beam
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from systems import Array, levels

_FINE = 20
"""Integration steps a sample."""


@dataclass(frozen=True)
class Plant:
    """A plant: names of its signals, its words, and `record`, which draws a record of it."""

    description: str
    sampling_time: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    samples: tuple[int, ...]
    """Samples of each record; the last record is the test."""
    record: Callable[[np.random.Generator, np.random.Generator, int], tuple[Array, Array]]
    """Numbers of the plant, random numbers of the record, samples -> u (T, nu), clean y (T, ny)."""
    noise: float = 0.01


def _simulate(
    slope: Callable[[Array, Array], Array],
    command: Callable[[int, Array], Array],
    start: Array,
    samples: int,
    step: float,
) -> tuple[Array, Array]:
    """Inputs (T, nu) and states (T, nx); `command` gives the input of a sample from the state."""
    inputs, states, x, h = [], [], start, step / _FINE
    for sample in range(samples):
        u = command(sample, x)
        inputs.append(u)
        states.append(x)
        for _ in range(_FINE):
            middle = x + h / 2 * slope(x, u)
            x = x + h * slope(middle, u)
    return np.array(inputs), np.array(states)


def _friction(speed: float, coulomb: float, extra: float, knee: float) -> float:
    rise = np.tanh(speed / (0.1 * knee))
    return float((coulomb + extra * np.exp(-((speed / knee) ** 2))) * rise)


def _positioning_drive(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Force in, position out; a controller follows trapezoidal speeds."""
    mass, viscous = numbers.uniform(80, 110), numbers.uniform(180, 240)
    coulomb, offset = numbers.uniform(18, 24), numbers.uniform(-4, -2)
    step = 0.005
    target = np.cumsum(0.5 * levels(60, 250, 0.4)(rng, samples)[:, 0]) * step
    target = np.convolve(target - np.linspace(0, target[-1], samples), np.ones(40) / 40, "same")

    def slope(x: Array, u: Array) -> Array:
        drag = viscous * x[1] + _friction(x[1], coulomb, 6.0, 0.01) + offset
        return np.array([x[1], (u[0] - drag) / mass])

    def command(sample: int, x: Array) -> Array:
        return np.array([np.clip(9000 * (target[sample] - x[0]) - 1100 * x[1], -150, 150)])

    u, x = _simulate(slope, command, np.zeros(2), samples, step)
    return u, x[:, :1]


def _exchanger(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Flow in, temperature out: exchange by the flow to the power 0.2, transport, two lags."""
    gain, pipe = numbers.uniform(0.7, 0.9), numbers.uniform(2.5, 4.0)
    lags = numbers.uniform(3, 5), numbers.uniform(8, 14)
    flow = levels(4, 30, 0.6, 1.0)(rng, samples)[:, 0]
    volume = np.cumsum(flow)
    entry = np.interp(volume - pipe, volume, np.arange(samples))
    hot = 100 - 80 * np.exp(-gain * np.interp(entry, np.arange(samples), flow) ** -0.2)
    walk = np.cumsum(0.003 * rng.standard_normal(samples))
    x = np.full(2, hot[0])
    answer = np.empty((samples, 1))
    for sample in range(samples):
        answer[sample] = x[1]
        for _ in range(_FINE):
            x = x + np.array([hot[sample] - x[0], x[0] - x[1]]) / lags / _FINE
    return flow[:, None], answer + walk[:, None]


def _flexible_arm(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Torque in, acceleration out; both modes soften and are damped more at large amplitude."""
    w = np.array([numbers.uniform(0.25, 0.35), numbers.uniform(0.9, 1.2)])
    d = numbers.uniform(0.01, 0.02, 2)
    soft, rub = numbers.uniform(0.1, 0.2, 2), numbers.uniform(0.02, 0.05, 2)
    share = np.array([1.0, -numbers.uniform(0.4, 0.8)])
    phases = rng.uniform(0, 2 * np.pi, 200)
    lines = np.arange(1, 201) * 2 * np.pi / 512
    torque = np.cos(np.arange(samples)[:, None] * lines + phases).sum(axis=1) / 14

    def accelerations(x: Array, u: Array) -> Array:
        q, v = x[:2], x[2:]
        size = (w * q) ** 2 + v**2
        stiff = w**2 * q * (1 - soft * size / (1 + size))
        return share * u[0] * w - stiff - 2 * (d + rub * np.sqrt(size)) * w * v

    u, x = _simulate(
        lambda x, u: np.concatenate([x[2:], accelerations(x, u)]),
        lambda sample, x: torque[sample : sample + 1],
        np.zeros(4),
        samples,
        1.0,
    )
    return u, np.array([[accelerations(a, b).sum()] for a, b in zip(x, u, strict=True)])


def _coupled_drives(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Voltage in, magnitude of the speed of a pulley on a springy belt out."""
    lag, w, d = numbers.uniform(0.3, 0.5), numbers.uniform(10, 14), numbers.uniform(0.1, 0.2)
    volts = levels(3, 40, 1.5)(rng, samples)[:, 0]

    def slope(x: Array, u: Array) -> Array:
        pull = w**2 * (x[0] - x[1]) - 2 * d * w * x[2]
        return np.array([(u[0] - x[0] - 0.1 * np.tanh(x[0] / 0.05)) / lag, x[2], pull])

    u, x = _simulate(
        slope, lambda sample, x: volts[sample : sample + 1], np.zeros(3), samples, 0.02
    )
    return u, np.abs(x[:, 1:2])


def _wing(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Force in, acceleration out; a mode of almost no damping, and gusts that nobody measures."""
    w = np.array([numbers.uniform(0.2, 0.3), numbers.uniform(0.32, 0.4)])
    d, hard = np.array([0.01, 0.03]), numbers.uniform(0.0003, 0.0006)
    force = np.convolve(rng.standard_normal(samples), np.ones(3) / 3, "same")
    gust = 0.03 * rng.standard_normal(samples)

    def slope(x: Array, u: Array) -> Array:
        q, v = x[:2], x[2:]
        return np.concatenate([v, w * (u[0] + u[1]) - w**2 * (q + hard * q**3) - 2 * d * w * v])

    u, x = _simulate(slope, lambda k, x: np.array([force[k], gust[k]]), np.zeros(4), samples, 1.0)
    return u[:, :1], x[:, :1] - 0.7 * x[:, 1:2]


def _ball_beam(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Angle in, position out: two integrators, rolling friction, a loop that follows steps."""
    pull, roll = numbers.uniform(5, 7), numbers.uniform(0.02, 0.05)
    goal = levels(30, 80, 0.02)(rng, samples)[:, 0]

    def slope(x: Array, u: Array) -> Array:
        return np.array([x[1], pull * u[0] - roll * np.tanh(x[1] / 0.005)])

    def command(sample: int, x: Array) -> Array:
        dither = 0.005 * rng.standard_normal()
        return np.array([0.35 * (goal[sample] - x[0]) - 0.35 * x[1] + dither])

    u, x = _simulate(slope, command, np.zeros(2), samples, 0.1)
    return u, x[:, :1]


def _soft_arm(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Three pressures at 120 degrees in, two bending angles out; stiffens, and creeps."""
    w, d, hard = numbers.uniform(2, 3), numbers.uniform(0.3, 0.5), numbers.uniform(0.3, 0.6)
    angles = np.array([0.0, 2.1, 4.2]) + numbers.uniform(-0.1, 0.1, 3)
    ways = np.stack([np.cos(angles), np.sin(angles)])
    pressure = np.maximum(levels(5, 40, 1.0, 0.6, 3)(rng, samples), 0)

    def slope(x: Array, u: Array) -> Array:
        q, v, creep, p = x[:2], x[2:4], x[4:6], x[6:]
        push = ways @ (p + 0.15 * p**2)
        stiff = w**2 * (1 + hard * float(q @ q)) * (q - 0.2 * creep)
        return np.concatenate(
            [v, w**2 * push - stiff - 2 * d * w * v, (q - creep) / 8, 5 * (u - p)]
        )

    u, x = _simulate(slope, lambda k, x: pressure[k], np.zeros(9), samples, 0.1)
    return u, x[:, :2]


def _two_mass(
    numbers: np.random.Generator, rng: np.random.Generator, samples: int
) -> tuple[Array, Array]:
    """Torque demand in, motor speed out; the torque is limited to 10, and both masses rub."""
    motor, load = numbers.uniform(0.04, 0.06), numbers.uniform(0.1, 0.15)
    stiff, damp = numbers.uniform(15, 25), numbers.uniform(0.1, 0.2)
    rub = numbers.uniform(1.0, 2.0)
    demand = levels(4, 30, 16.0)(rng, samples)[:, 0]

    def slope(x: Array, u: Array) -> Array:
        twist = stiff * x[0] + damp * (x[1] - x[2])
        return np.array(
            [
                x[1] - x[2],
                (np.clip(u[0], -10, 10) - twist - 0.3 * x[1] - _friction(x[1], rub, 0.3, 0.5))
                / motor,
                (twist - 0.2 * x[2] - _friction(x[2], 0.5, 0.0, 0.5)) / load,
            ]
        )

    u, x = _simulate(slope, lambda k, x: demand[k : k + 1], np.zeros(3), samples, 0.02)
    return u, x[:, 1:2]


PLANTS: dict[str, Plant] = {
    "positioning_drive": Plant(
        "A linear drive with friction under a position controller: motor force in, position out.",
        0.005, ("force",), ("position",), (6000, 3000), _positioning_drive, 0.001,
    ),
    "exchanger": Plant(
        "A heat exchanger: water is heated by steam; its flow in, its outlet temperature out.",
        1.0, ("flow",), ("temperature",), (2400, 1200), _exchanger,
    ),
    "flexible_arm": Plant(
        "A flexible robot arm on a motor: reaction torque in, acceleration of the arm out.",
        1.0, ("torque",), ("acceleration",), (682, 342), _flexible_arm, 0.005,
    ),
    "coupled_drives": Plant(
        "Two motors drive a pulley by a belt on springs. The sensor of the pulley's speed gives "
        "the magnitude, not the sign.",
        0.02, ("voltage",), ("speed",), (330, 170), _coupled_drives,
    ),
    "wing": Plant(
        "A wing in a wind tunnel near flutter: force in, response out.",
        1.0, ("force",), ("response",), (682, 342), _wing,
    ),
    "ball_beam": Plant(
        "A ball on a beam: angle of the beam in, position of the ball out, under control.",
        0.1, ("angle",), ("position",), (667, 333), _ball_beam,
    ),
    "soft_arm": Plant(
        "A soft robot arm: three pressures in, two bending angles out.",
        0.1, ("p1", "p2", "p3"), ("bend_x", "bend_y"), (400, 400, 400, 400, 400), _soft_arm,
    ),
    "two_mass": Plant(
        "Two masses on a shaft: demanded torque in, motor speed out.",
        0.02, ("torque",), ("speed",), (1500, 1000), _two_mass,
    ),
}  # fmt: skip


def write(name: str, out: Path, seed: int) -> Path:
    """Write the problem directory of a plant."""
    plant, directory = PLANTS[name], out / name
    directory.mkdir(parents=True, exist_ok=True)
    files = [f"record{i + 1}.csv" for i in range(len(plant.samples) - 1)] + ["test.csv"]
    for i, (file, samples) in enumerate(zip(files, plant.samples, strict=True)):
        numbers = np.random.default_rng([seed, *name.encode()])
        rng = np.random.default_rng([seed, i, *name.encode()])
        u, y = plant.record(numbers, rng, samples)
        y = y + plant.noise * y.std(axis=0) * rng.standard_normal(y.shape)
        header = ",".join([*plant.inputs, *plant.outputs])
        np.savetxt(directory / file, np.hstack([u, y]), "%.7g", ",", header=header, comments="")
    (directory / "description.md").write_text(plant.description + "\n", encoding="utf-8")

    def signals(names: tuple[str, ...]) -> str:
        return "[" + ", ".join(f'{{ name = "{name}" }}' for name in names) + "]"

    train = ", ".join(f'"{file}"' for file in files[:-1])
    (directory / "problem.toml").write_text(
        f'name = "{name}"\ndescription = "description.md"\n'
        f"sampling_time = {plant.sampling_time}\n"
        f"inputs = {signals(plant.inputs)}\noutputs = {signals(plant.outputs)}\n"
        f'[data]\ntrain = [{train}]\ntest = ["test.csv"]\n'
        '[protocol]\nkind = "simulation"\nfolds = { kind = "contiguous", count = 3 }\n'
        'past_inputs = 10\npast_outputs = 10\nmetric = "rmse"\n'
        "[budget]\nexperiments = 8\n",
        encoding="utf-8",
    )
    return directory


def main() -> None:
    """Write the problem directories."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--systems", nargs="+", default=list(PLANTS), choices=list(PLANTS))
    options = parser.parse_args()
    for name in options.systems:
        print(write(name, options.out, options.seed))


if __name__ == "__main__":
    main()
