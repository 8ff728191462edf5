"""Small simulated systems with known noise-free outputs, shared by the black-box tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asia.candidate import Context, Model
from asia.data import Array, Signal, Trajectory

PAST = 8
A = np.array([[0.8, 0.3], [-0.3, 0.8]])
B = np.array([[0.2], [0.1]])
C = np.array([[1.0, 0.5]])


def filtered(u: Array, a: Array = A, b: Array = B, c: Array = C) -> Array:
    """Output of a strictly proper linear system from rest."""
    x, rows = np.zeros(len(a)), []
    for row in u:
        rows.append(c @ x)
        x = a @ x + b @ row
    return np.array(rows)


def wiener(u: Array) -> Array:
    return np.tanh(1.5 * filtered(u))


def late(u: Array) -> Array:
    return filtered(np.concatenate([np.zeros((5, 1)), u[:-5]]))


def two_by_two(u: Array) -> Array:
    a = np.array([[0.9, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.0, 0.6]])
    b = np.array([[0.3, 0.0], [0.1, 0.4], [0.5, 0.5]])
    return filtered(u, a, b, np.array([[1.0, 0.0, 0.3], [0.0, 1.0, 0.5]]))


@dataclass(frozen=True)
class Case:
    """Noisy training records, and an unseen record with its noise-free output."""

    training: list[Trajectory]
    unseen: Trajectory
    truth: Array
    noise: Array
    context: Context

    def ratio(self, model: Model) -> float:
        """Simulation error against the truth, over the noise's standard deviation."""
        y = self.simulated(model)
        error = np.sqrt(((y - self.truth[PAST:]) ** 2).mean(axis=0))
        return float((error / self.noise).mean())

    def simulated(self, model: Model) -> Array:
        u, y = self.unseen.u, self.unseen.y
        return model.simulate(u[None, :PAST], y[None, :PAST], u[None, PAST:])[0]


def case(
    system: Callable[[Array], Array],
    channels: int = 1,
    lengths: tuple[int, ...] = (400,),
    noise: float = 0.05,
) -> Case:
    """Records in arbitrary physical units: offset and gain on the output."""
    rng = np.random.default_rng(7)

    def record(length: int) -> tuple[Array, Array]:
        u = np.repeat(rng.standard_normal((length // 3 + 1, channels)), 3, axis=0)[:length]
        return 2.0 + u, 5.0 + 3.0 * system(u)

    pairs = [record(length) for length in (*lengths, 300)]
    sigma = noise * np.concatenate([y for _, y in pairs[:-1]]).std(axis=0)
    noisy = [Trajectory(u, y + sigma * rng.standard_normal(y.shape), 1.0) for u, y in pairs]
    context = Context(
        inputs=tuple(Signal(f"u{i}") for i in range(channels)),
        outputs=tuple(Signal(f"y{i}") for i in range(channels)),
        sampling_time=1.0,
        n_past_u=PAST,
        n_past_y=PAST,
        seed=3,
    )
    return Case(noisy[:-1], noisy[-1], pairs[-1][1], sigma, context)
