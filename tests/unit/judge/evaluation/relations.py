"""Held-out blocks of a lightly damped system, and models that answer them, honestly or not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from asia.candidate import StepModel, simulate_steps
from asia.data import Array, Trajectory
from asia.data.segment import Segment
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.relations import Suspicion, suspicions
from asia.judge.evaluation.requests import simulate_held_out
from asia.judge.sandbox.worker.prefixes import by_prefixes
from asia.problem.folds import Fold, make_folds
from asia.problem.protocol import ProtocolRule

Answer = Callable[[Array, Array, Array], Array]


def step(y1: Array, y2: Array, u: Array) -> Array:
    """Advance the part shared by the system and an honest model of it."""
    return 1.6 * y1 - 0.7 * y2 + 0.1 * u + 0.05 * np.tanh(u * y1)


def record(seed: int, length: int = 240, name: str = "", hold: int = 4) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=length // hold), hold)
    y = np.zeros(length)
    for k in range(2, length):
        y[k] = step(y[k - 1], y[k - 2], u[k]) - 0.02 * y[k - 1] ** 3
    return Trajectory(u, y + 0.01 * rng.normal(size=length), 1.0, name)


def honest(past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate without the cubic term: an error of some tenths."""
    y = np.concatenate([past_y, np.zeros((*u.shape[:2], 1))], axis=1)
    n = past_y.shape[1]
    for k in range(n, y.shape[1]):
        y[:, k] = step(y[:, k - 1], y[:, k - 2], u[:, k - n])
    return y[:, n:]


def finite(y: Array) -> Array:
    if not np.isfinite(y).all():
        raise CandidateError(Reason.NOT_FINITE)
    return y


@dataclass
class Model:
    """Answers with a function, by prefixes and checked as a worker's answers are."""

    answer: Answer
    asked: list[tuple[int, ...]] = field(default_factory=list)
    has_steps: bool = False

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        return finite(by_prefixes(self._whole, past_u, past_y, u, secret))

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        return finite(self._whole(past_u, past_y, u))

    def _whole(self, past_u: Array, past_y: Array, u: Array) -> Array:
        self.asked.append(u.shape)
        return np.array(self.answer(past_u, past_y, u), np.float64)


@dataclass
class Stepping:
    """Answers sample by sample."""

    model: StepModel
    has_steps: bool = True

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        del secret
        return finite(simulate_steps(self.model, past_u, past_y, u))

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        raise AssertionError("a model with steps is asked sample by sample")


def fold(horizon: int | None = None, records: int = 3, hold: int = 4) -> Fold:
    kind = "simulation" if horizon is None else "windows"
    rule = ProtocolRule(kind=kind, past_inputs=3, past_outputs=3, horizon=horizon)
    made = [record(seed, name=f"r{seed}", hold=hold) for seed in range(records)]
    return make_folds(made, rule)[1]


def found(answer: Answer, horizon: int | None = None, records: int = 3) -> tuple[Suspicion, ...]:
    """Return the suspicions for simulations of the fold's held-out blocks."""
    held = fold(horizon, records)
    return suspicions_of(Model(answer), held.held_out, held.scale, horizon)


def suspicions_of(
    model: Model | Stepping, blocks: Sequence[Segment], scale: Array, horizon: int | None
) -> tuple[Suspicion, ...]:
    y_hat = simulate_held_out(model, blocks)
    followed = range(len(blocks)) if horizon is None else ()
    return suspicions(model, blocks, y_hat, scale, horizon, followed=followed)
