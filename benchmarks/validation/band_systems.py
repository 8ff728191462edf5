"""Systems and quick models for bands.py: everything is NumPy, many cases are simulated at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from asia.data import Array, Trajectory

PAST = 8
SETTLE = 200
Random = np.random.Generator
Excite = Callable[[Random, int], Array]
"""Random numbers and a length T -> u (T, nu)."""
Respond = Callable[[Array], Array]
"""u (T, nu) -> y (T, ny) without noise."""


@dataclass(frozen=True)
class Kind:
    """A kind of system with its noise."""

    name: str
    draw: Callable[[Random], Respond]
    inputs: int = 1
    shortest: int = 3
    longest: int = 20
    """How long a level of the input lasts, in samples."""
    noise: float = 0.05
    """Its share of the deviation of the output."""
    colour: float = 0.0
    """Pole of the noise."""
    heavy: bool = False
    """Whether the noise has heavy tails (Student, 3 degrees of freedom)."""


@dataclass(frozen=True)
class System:
    """One system of a kind."""

    kind: Kind
    respond: Respond
    size: Array
    """Deviation (ny,) of the output under inputs of the kind."""

    def record(
        self, rng: Random, samples: int, scale: float = 1.0, slower: float = 1.0
    ) -> Trajectory:
        """A record whose input is `scale` times as large and `slower` times as slow as usual."""
        u = scale * levels(rng, self.kind, samples + SETTLE, slower)
        y = self.respond(u)
        e = rng.standard_t(3, y.shape) / np.sqrt(3) if self.kind.heavy else rng.normal(size=y.shape)
        pole = self.kind.colour
        e = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], e, axis=0)
        y = y + self.kind.noise * self.size * e
        return Trajectory(u[SETTLE:], y[SETTLE:], 1.0, "record")


def make_system(kind: Kind, rng: Random) -> System:
    """A system with its numbers drawn."""
    respond = kind.draw(rng)
    return System(kind, respond, respond(levels(rng, kind, 2000 + SETTLE, 1.0))[SETTLE:].std(0))


def levels(rng: Random, kind: Kind, samples: int, slower: float) -> Array:
    """Random levels between -1 and 1, each held for a random time."""
    columns: list[Array] = []
    for _ in range(kind.inputs):
        longest = max(1, round(kind.longest * slower))
        lengths = rng.integers(max(1, round(kind.shortest * slower)), longest + 1, samples)
        columns.append(np.repeat(rng.uniform(-1.0, 1.0, samples), lengths)[:samples])
    return np.stack(columns, axis=1)


def _resonance(rng: Random) -> Respond:
    w, d = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.6)
    radius = np.exp(-d * w)
    a = [1.0, -2 * radius * np.cos(w * np.sqrt(1 - d**2)), radius**2]
    return lambda x: lfilter([0.0, sum(a)], a, x, axis=0)


def _linear(rng: Random) -> Respond:
    return _resonance(rng)


def _slow(rng: Random) -> Respond:
    pole = rng.uniform(0.97, 0.99)
    return lambda u: lfilter([0.0, 1 - pole], [1.0, -pole], u, axis=0)


def _wiener(rng: Random) -> Respond:
    linear, bend = _resonance(rng), rng.uniform(0.5, 1.5)
    return lambda u: np.tanh(2 * bend * linear(u)) + 0.3 * bend * linear(u) ** 2


def _hammerstein(rng: Random) -> Respond:
    linear, bend = _resonance(rng), rng.uniform(1.0, 4.0)
    return lambda u: linear(np.tanh(bend * (u - 0.2)))


def _hardening(rng: Random) -> Respond:
    """A mass on a spring that hardens, stepped with a semi-implicit rule."""
    k, c, k3 = rng.uniform(0.03, 0.1), rng.uniform(0.1, 0.2), rng.uniform(0.03, 0.2)

    def respond(u: Array) -> Array:
        x = v = 0.0
        out = np.zeros(len(u))
        for t, force in enumerate(u[:, 0].tolist()):
            out[t] = x
            v += 0.1 * force - k * x - k3 * x**3 - c * v
            x += v
        return out[:, None]

    return respond


def _several(rng: Random) -> Respond:
    """Two inputs, two outputs, a product between the states."""
    first, second = _resonance(rng), _resonance(rng)
    mixed = rng.uniform(0.2, 1.0, (2, 2))

    def respond(u: Array) -> Array:
        v = u @ mixed
        a, b = first(v[:, :1]), second(v[:, 1:])
        return np.hstack([a + 0.5 * a * b, b - 0.3 * a**2])

    return respond


KINDS = (
    Kind("linear", _linear),
    Kind("coloured noise", _linear, colour=0.9, noise=0.1),
    Kind("heavy tails", _linear, heavy=True, noise=0.1),
    Kind("slow", _slow, shortest=10, longest=80, colour=0.95),
    Kind("Wiener", _wiener),
    Kind("Hammerstein", _hammerstein),
    Kind("hard spring", _hardening, noise=0.02),
    Kind("two outputs", _several, inputs=2),
)


@dataclass(frozen=True)
class Model:
    """One step ahead, simulated in open loop: lags of outputs and inputs, and random functions of
    these."""

    lags: int
    centre: Array
    size: Array
    inner: Array
    """(regressors + 1, functions)."""
    weights: Array
    low: Array
    high: Array
    """Outputs stay within three times the range of the training."""

    def rows(self, lagged: Array) -> Array:
        """Regressors (N, p) -> columns of the regression."""
        z = (lagged - self.centre) / self.size
        one = np.ones((len(z), 1))
        return np.hstack([z, one, np.tanh(np.hstack([z, one]) @ self.inner)])

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, PAST, nu), past_y (B, PAST, ny), u (B, H, nu) -> (B, H, ny)."""
        inputs = np.concatenate([past_u, u], axis=1)
        y = np.concatenate([past_y, np.zeros((*u.shape[:2], past_y.shape[2]))], axis=1)
        for t in range(PAST, y.shape[1]):
            before = y[:, t - self.lags : t].reshape(len(y), -1)
            driven = inputs[:, t - self.lags : t + 1].reshape(len(y), -1)
            step = self.rows(np.hstack([before, driven])) @ self.weights
            y[:, t] = np.clip(step, self.low, self.high)
        return y[:, PAST:]


def fit(records: Sequence[Trajectory], lags: int, functions: int, seed: int) -> Model:
    """Least squares with a small ridge on the random functions."""
    lagged, after = [], []
    windows = np.lib.stride_tricks.sliding_window_view
    for record in records:
        before = windows(record.y[:-1], lags, axis=0).transpose(0, 2, 1)
        driven = windows(record.u, lags + 1, axis=0).transpose(0, 2, 1)
        lagged.append(np.hstack([x.reshape(len(x), -1) for x in (before, driven)]))
        after.append(record.y[lags:])
    x, target = np.concatenate(lagged), np.concatenate(after)
    centre, size = x.mean(0), x.std(0) + 1e-9
    inner = np.random.default_rng(seed).normal(size=(x.shape[1] + 1, functions))
    inner /= np.sqrt(x.shape[1])
    low, high = target.min(0), target.max(0)
    wide = high - low
    model = Model(lags, centre, size, inner, np.zeros(0), low - wide, high + wide)
    columns = model.rows(x)
    ridge = np.r_[np.full(x.shape[1] + 1, 1e-6), np.full(functions, 0.3)]
    weights = np.linalg.solve(columns.T @ columns + np.diag(ridge), columns.T @ target)
    return Model(lags, centre, size, inner, weights, low - wide, high + wide)
