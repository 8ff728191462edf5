"""Synthetic systems whose noise-free output is known.

Every number of a system, its inputs and its noise follow from a seed, so that each seed is another
set of systems of the same kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]
Response = Callable[[Array], Array]
"""u (T, nu), held between samples, from rest -> noise-free y (T, ny)."""
Excite = Callable[[np.random.Generator, int], Array]
"""Random numbers and a length T -> u (T, nu)."""

SAMPLES = 1000
SETTLE = 200
PAST = 10
_PARTS = ("train", "test")


@dataclass(frozen=True)
class Kind:
    """A kind of system: `draw` fixes its numbers, `excite` makes an input (T, nu)."""

    name: str
    description: str
    sampling_time: float
    ny: int
    excite: Excite
    draw: Callable[[np.random.Generator], Response]
    physics: str = ""


@dataclass(frozen=True)
class Record:
    """u (T, nu), measured y (T, ny) and noise-free truth (T, ny)."""

    u: Array
    y: Array
    truth: Array


@dataclass(frozen=True)
class System:
    """A drawn system: two records of it and the standard deviation (ny,) of its sensor noise."""

    kind: Kind
    train: Record
    test: Record
    noise_std: Array


def make_system(kind: Kind, seed: int) -> System:
    """Draw the numbers of a kind and record it twice, with another input realisation each.

    White Gaussian sensor noise, 30 to 40 dB below the standard deviation of the training output.
    """
    numbers = np.random.default_rng([seed, *kind.name.encode()])
    respond = kind.draw(numbers)
    snr_db = numbers.uniform(30.0, 40.0)
    clean: list[tuple[Array, Array]] = []
    for part in range(len(_PARTS)):
        u = kind.excite(np.random.default_rng([seed, part, *kind.name.encode()]), SAMPLES + SETTLE)
        clean.append((u[SETTLE:], respond(u)[SETTLE:]))
    noise_std = clean[0][1].std(axis=0) * 10.0 ** (-snr_db / 20.0)
    records = [Record(u, y + noise_std * numbers.standard_normal(y.shape), y) for u, y in clean]
    return System(kind, records[0], records[1], noise_std)


def write_problem(system: System, directory: Path, experiments: int) -> Path:
    """A problem directory: CSV files, problem.toml and description.md. The truth is not in it."""
    kind = system.kind
    directory.mkdir(parents=True, exist_ok=True)
    inputs = [f"u{i + 1}" for i in range(system.train.u.shape[1])]
    outputs = [f"y{i + 1}" for i in range(kind.ny)]
    for name, record in zip(_PARTS, (system.train, system.test), strict=True):
        np.savetxt(
            directory / f"{name}.csv",
            np.hstack([record.u, record.y]),
            fmt="%.9g",
            delimiter=",",
            header=",".join([*inputs, *outputs]),
            comments="",
        )
    (directory / "description.md").write_text(kind.description + "\n")
    (directory / "problem.toml").write_text(
        f'name = "{kind.name}"\n'
        'description = "description.md"\n'
        f"sampling_time = {kind.sampling_time}\n"
        f"inputs = {inputs}\n"
        f"outputs = {outputs}\n"
        '[data]\ntrain = ["train.csv"]\ntest = ["test.csv"]\n'
        '[protocol]\nfolds = { kind = "contiguous", count = 2 }\n'
        f"past_inputs = {PAST}\npast_outputs = {PAST}\n"
        f"[budget]\nexperiments = {experiments}\n{kind.physics}"
    )
    return directory


def _multisine(rng: np.random.Generator, samples: int, band: float) -> Array:
    """Random-phase multisine (Schoukens & Ljung 2019), flat up to `band` of the Nyquist frequency,
    with unit standard deviation. (T,)"""
    lines = np.arange(1, max(3, int(band * samples / 2)))
    phases = rng.uniform(0.0, 2.0 * np.pi, lines.size)
    time = np.arange(samples)[:, None] / samples
    return np.cos(2.0 * np.pi * lines * time + phases).sum(axis=1) / np.sqrt(lines.size / 2)


def _steps(rng: np.random.Generator, samples: int, shortest: int, longest: int) -> Array:
    """Random levels in -1 to 1, each held for a random time. (T,)"""
    values: list[float] = []
    while len(values) < samples:
        values += [rng.uniform(-1.0, 1.0)] * int(rng.integers(shortest, longest + 1))
    return np.array(values[:samples])


def _waves(band: float, scale: float = 1.0) -> Excite:
    def excite(rng: np.random.Generator, samples: int) -> Array:
        return scale * _multisine(rng, samples, band)[:, None]

    return excite


def levels(shortest: int, longest: int, scale: float, mean: float = 0.0, count: int = 1) -> Excite:
    def excite(rng: np.random.Generator, samples: int) -> Array:
        return mean + scale * np.stack(
            [_steps(rng, samples, shortest, longest) for _ in range(count)], axis=1
        )

    return excite


def _resonance(rng: np.random.Generator, low: float, high: float) -> tuple[Array, Array]:
    """Discrete second-order system of unit static gain; its frequency in rad per sample."""
    w, d = rng.uniform(low, high), rng.uniform(0.15, 0.5)
    discrete: Any = signal.cont2discrete(([w * w], [1.0, 2 * d * w, w * w]), 1.0)
    return np.ravel(discrete[0]), np.ravel(discrete[1])


def _lag(rng: np.random.Generator, low: float, high: float) -> tuple[Array, Array]:
    """First-order lag of unit static gain, its pole between `low` and `high`."""
    pole = rng.uniform(low, high)
    return np.array([0.0, 1.0 - pole]), np.array([1.0, -pole])


def _filter(block: tuple[Array, Array], u: Array) -> Array:
    return np.asarray(signal.lfilter(*block, u, axis=0))


def integrate(
    slope: Callable[[list[float], list[float]], list[float]],
    start: list[float],
    u: Array,
    step: float,
    substeps: int,
) -> Array:
    """States (T, n) at each sample; Runge-Kutta of order four with the input held."""
    h, x = step / substeps, start
    answer = np.empty((len(u), len(start)))

    def ahead(base: list[float], k: list[float], by: float) -> list[float]:
        return [b + by * v for b, v in zip(base, k, strict=True)]

    for sample, now in enumerate(u.tolist()):
        answer[sample] = x
        for _ in range(substeps):
            k1 = slope(x, now)
            k2 = slope(ahead(x, k1, h / 2), now)
            k3 = slope(ahead(x, k2, h / 2), now)
            k4 = slope(ahead(x, k3, h), now)
            x = [
                v + h / 6 * (a + 2 * b + 2 * c + d)
                for v, a, b, c, d in zip(x, k1, k2, k3, k4, strict=True)
            ]
    return answer


def _linear(rng: np.random.Generator) -> Response:
    first, second = _resonance(rng, 0.25, 0.6), _lag(rng, 0.6, 0.85)
    return lambda u: _filter(second, _filter(first, u))


def _wiener(rng: np.random.Generator) -> Response:
    block = _resonance(rng, 0.2, 0.5)
    gain, bend = rng.uniform(0.8, 1.5), rng.uniform(0.05, 0.2)

    def respond(u: Array) -> Array:
        x = _filter(block, u)
        return np.tanh(gain * x) + bend * x**2

    return respond


def _hammerstein(rng: np.random.Generator) -> Response:
    block = _resonance(rng, 0.2, 0.5)
    dead, limit = rng.uniform(0.2, 0.4), rng.uniform(1.2, 1.8)

    def respond(u: Array) -> Array:
        v = np.sign(u) * np.clip(np.abs(u) - dead, 0.0, limit - dead)
        return _filter(block, v)

    return respond


def _wiener_hammerstein(rng: np.random.Generator) -> Response:
    first, second = _resonance(rng, 0.3, 0.6), _lag(rng, 0.5, 0.8)
    knee = rng.uniform(0.4, 0.8)

    def respond(u: Array) -> Array:
        x = _filter(first, u)
        soft = np.where(x > knee, knee + 0.2 * (x - knee), x)
        return _filter(second, soft)

    return respond


def _duffing(rng: np.random.Generator) -> Response:
    damping, stiffness = rng.uniform(0.2, 0.4), rng.uniform(0.8, 1.2)
    cubic = rng.uniform(0.5, 1.0)

    def slope(x: list[float], u: list[float]) -> list[float]:
        q, v = x
        return [v, u[0] - damping * v - stiffness * q - cubic * q**3]

    return lambda u: integrate(slope, [0.0, 0.0], u, 0.2, 8)[:, :1]


def _friction(rng: np.random.Generator) -> Response:
    mass, viscous = rng.uniform(0.8, 1.2), rng.uniform(0.3, 0.5)
    coulomb, extra = rng.uniform(0.4, 0.6), rng.uniform(0.15, 0.3)

    def slope(x: list[float], u: list[float]) -> list[float]:
        v = x[0]
        dry = (coulomb + extra * float(np.exp(-((v / 0.1) ** 2)))) * float(np.tanh(v / 0.01))
        return [(u[0] - dry - viscous * v) / mass]

    return lambda u: integrate(slope, [0.0], u, 0.05, 40)


def _bilinear(rng: np.random.Generator) -> Response:
    a, c = rng.uniform(0.4, 0.6), rng.uniform(0.8, 1.2)
    flow, gain = rng.uniform(0.4, 0.7), rng.uniform(0.8, 1.2)

    def slope(x: list[float], u: list[float]) -> list[float]:
        return [-a * x[0] - flow * x[0] * u[0] + gain * u[0], c * (x[0] - x[1])]

    return lambda u: integrate(slope, [0.0, 0.0], u, 0.5, 4)[:, 1:]


_TANKS = """
[physics]
states = ["x1", "x2"]
[physics.parameters]
k1 = { min = 1e-3, max = 1.0 }
k2 = { min = 1e-3, max = 1.0 }
k3 = { min = 1e-3, max = 1.0 }
k4 = { min = 1e-3, max = 1.0 }
[physics.dynamics]
x1 = "-k1*sqrt(x1) + k4*u1"
x2 = "k2*sqrt(x1) - k3*sqrt(x2)"
[physics.observation]
y1 = "x2"
[physics.bounds]
x1 = { min = 0.0 }
x2 = { min = 0.0 }
"""


def _tanks(rng: np.random.Generator) -> Response:
    out1, into2, out2 = rng.uniform(0.25, 0.35), rng.uniform(0.2, 0.3), rng.uniform(0.2, 0.3)
    pump, leak, offset = rng.uniform(0.2, 0.3), rng.uniform(0.01, 0.02), rng.uniform(0.3, 0.6)

    def slope(x: list[float], u: list[float]) -> list[float]:
        root1, root2 = max(x[0], 0.0) ** 0.5, max(x[1], 0.0) ** 0.5
        return [pump * u[0] - out1 * root1 - leak * x[0], into2 * root1 - out2 * root2]

    return lambda u: offset + integrate(slope, [2.0, 2.0], np.maximum(u, 0.0), 1.0, 4)[:, 1:]


def _delay(rng: np.random.Generator) -> Response:
    first, second = _lag(rng, 0.6, 0.8), _lag(rng, 0.3, 0.6)
    dead = int(rng.integers(7, 10))

    def respond(u: Array) -> Array:
        late = np.vstack([np.zeros((dead, 1)), u[:-dead]])
        return _filter(second, _filter(first, late))

    return respond


def _mimo(rng: np.random.Generator) -> Response:
    """Quadruple tank (Johansson 2000, IEEE Trans. Control Syst. Technol. 8(3), eq. 2)."""
    outlet = [float(v) for v in rng.uniform(0.2, 0.35, size=4)]
    share1, share2 = rng.uniform(0.55, 0.75), rng.uniform(0.55, 0.75)

    def slope(x: list[float], u: list[float]) -> list[float]:
        r = [k * max(v, 0.0) ** 0.5 for k, v in zip(outlet, x, strict=True)]
        p = [0.3 * max(v, 0.0) for v in u]
        return [
            r[2] - r[0] + share1 * p[0],
            r[3] - r[1] + share2 * p[1],
            (1.0 - share2) * p[1] - r[2],
            (1.0 - share1) * p[0] - r[3],
        ]

    return lambda u: integrate(slope, [2.0, 2.0, 1.0, 1.0], u, 1.0, 4)[:, :2]


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("linear", "A linear resonant system behind a lag.", 0.1, 1, _waves(0.4), _linear),
        Kind(
            "wiener",
            "Linear dynamics, then a sensor that saturates and bends.",
            0.1,
            1,
            _waves(0.3),
            _wiener,
        ),
        Kind(
            "hammerstein",
            "An actuator with a dead zone and a limit drives linear dynamics.",
            0.1,
            1,
            _waves(0.3),
            _hammerstein,
        ),
        Kind(
            "wiener_hammerstein",
            "Linear dynamics, a static element that clips one side softly, linear dynamics.",
            0.1,
            1,
            _waves(0.4),
            _wiener_hammerstein,
        ),
        Kind(
            "duffing",
            "A driven mass on a spring that stiffens with displacement; the displacement is "
            "measured.",
            0.2,
            1,
            _waves(0.15, 0.8),
            _duffing,
        ),
        Kind(
            "friction",
            "A mass driven by a force against dry and viscous friction; it sticks. The velocity "
            "is measured.",
            0.05,
            1,
            levels(10, 40, 1.8),
            _friction,
        ),
        Kind(
            "bilinear",
            "A flow heats a vessel: the input multiplies the state. The sensor lags.",
            0.5,
            1,
            levels(3, 20, 0.9, 1.0),
            _bilinear,
        ),
        Kind(
            "tanks",
            "Water from a pump runs through an upper tank into a lower one, whose level is "
            "measured. The vessels are old and the sensor was never zeroed.",
            1.0,
            1,
            levels(8, 40, 1.2, 1.8),
            _tanks,
            _TANKS,
        ),
        Kind("delay", "A linear process behind a long pipe.", 1.0, 1, levels(2, 15, 1.0), _delay),
        Kind(
            "mimo",
            "Four tanks and two pumps, each of which feeds two tanks across; the levels of the "
            "two lower tanks are measured.",
            1.0,
            2,
            levels(10, 40, 1.0, 1.6, 2),
            _mimo,
        ),
    )
}
