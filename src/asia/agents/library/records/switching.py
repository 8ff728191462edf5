"""Detection of dry friction, hysteresis and backlash.

The test relates the error of a one-step model with smooth terms to a direction of motion, or to the
memory of where a signal reversed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from asia.agents._view import Facts
from asia.data import Array

Cause = Literal["velocity", "displacement", "input"]

# Share of the one-step error's square that a switching term has to explain; smooth curves that the
# terms of the model lack look a little like a displacement's.
_LEAST_SHARE: dict[Cause, float] = {"velocity": 0.05, "displacement": 0.13, "input": 0.1}
_LAGS, _MOST_SAMPLES = 6, 4000
# Reach of the memory in standard deviations: of an output, and of an input.
_OUTPUT_REACH, _INPUT_REACH = (0.05, 0.2, 0.6), (0.1, 0.5)
_FINE = 0.1


@dataclass(frozen=True)
class Switching:
    """The switching term that explains most."""

    share: float
    """Share of the squared one-step error that remains with smooth terms."""
    cause: Cause
    """"velocity": the sign of an output; "displacement": which way an output moves, or where it
    turned; "input": where an input turned."""
    signal: int
    """Number of that output or input."""

    @property
    def found(self) -> bool:
        """Whether it is more than chance and smooth curves give."""
        return self.share >= _LEAST_SHARE[self.cause]


def switching(facts: Facts) -> Switching:
    """The one of the training records."""
    records = facts.records
    most = max(_MOST_SAMPLES // len(records), 50 * _LAGS)
    pieces = [r[:most] for r in records if len(r) > 20 * _LAGS]
    return _switching(tuple(_Samples(r.u.tobytes(), r.y.tobytes(), len(r)) for r in pieces))


def moved_with_stop(signal: Array, reach: float) -> Array:
    """The stop operator (T,): it follows the signal's changes (T,) within `reach` of zero, in
    units of it."""
    state, found = 0.0, np.empty(len(signal))
    for k, change in enumerate(np.diff(signal, prepend=signal[0])):
        state = min(max(state + change, -reach), reach)
        found[k] = state / reach
    return found


class _Samples(NamedTuple):
    """Segment of a record, hashable."""

    u: bytes
    y: bytes
    length: int

    def arrays(self) -> tuple[Array, Array]:
        """Inputs (T, nu) and outputs (T, ny)."""
        u, y = (np.frombuffer(b).reshape(self.length, -1) for b in (self.u, self.y))
        return u, y


@lru_cache(maxsize=16)
def _switching(pieces: tuple[_Samples, ...]) -> Switching:
    best = Switching(0.0, "velocity", 0)
    records = [piece.arrays() for piece in pieces]
    for output in range(records[0][1].shape[1] if records else 0):
        for found in _of_output(records, output):
            best = max(best, found, key=lambda s: s.share)
    return best


def _of_output(records: list[tuple[Array, Array]], output: int) -> list[Switching]:
    u, y = (np.concatenate(part) for part in zip(*records, strict=True))
    size, spread = y[:, output].std() or 1.0, np.where(u.std(axis=0) > 0, u.std(axis=0), 1.0)
    outputs = [y[:, output] / size for _, y in records]
    inputs = [u / spread for u, _ in records]
    mean, level = y[:, output].mean() / size, u.mean(axis=0) / spread
    smooth = np.concatenate(
        [_smooth(v, w, mean, level) for v, w in zip(outputs, inputs, strict=True)]
    )
    target = np.concatenate([v[_LAGS:] for v in outputs])
    basis = np.linalg.qr(smooth)[0]
    error = target - basis @ (basis.T @ target)
    found: list[Switching] = []
    pace = np.concatenate([np.diff(v) for v in outputs]).std() or 1.0
    for cause, signal, parts in _terms(outputs, inputs, pace):
        term = np.concatenate(parts)
        term = term - basis @ (basis.T @ term)
        gain = np.linalg.lstsq(term, error, rcond=None)[0]
        left = float(((error - term @ gain) ** 2).sum() / max(float((error**2).sum()), 1e-300))
        found.append(Switching(1.0 - left, cause, output if signal < 0 else signal))
    return found


def _terms(
    outputs: list[Array], inputs: list[Array], pace: float
) -> list[tuple[Cause, int, list[Array]]]:
    """Switching terms (T, n) of each record, with their cause and the number of the input."""
    found: list[tuple[Cause, int, list[Array]]] = [
        ("velocity", -1, [_late(np.sign(v), 1) for v in outputs]),
        (
            "displacement",
            -1,
            [_late(np.tanh(np.diff(v, prepend=v[0]) / (_FINE * pace)), 1) for v in outputs],
        ),
    ]
    for reach in _OUTPUT_REACH:
        stops = [moved_with_stop(v, reach) for v in outputs]
        found.append(("displacement", -1, [_late(s, 1) for s in stops]))
    for j in range(inputs[0].shape[1]):
        for reach in _INPUT_REACH:
            stops = [moved_with_stop(w[:, j], reach) for w in inputs]
            found.append(("input", j, [np.hstack([_late(s, 0), _late(s, 1)]) for s in stops]))
    return found


def _smooth(y: Array, u: Array, mean: float, level: Array) -> Array:
    """Lags of one output (T,) and of the inputs (T, nu), and their first products."""
    past, now = _late(y, 1) - mean, _late(u, 1) - level
    lags = [_late(y, k) for k in range(1, _LAGS + 1)] + [_late(u, k) for k in range(_LAGS)]
    bent = [past**2, past**3, now**2, now**3, past * now, past**2 * now, past * now**2]
    return np.hstack([np.ones((len(past), 1)), *lags, *bent])


def _late(values: Array, lag: int) -> Array:
    """Columns (T - lags, n) that lag behind the samples from the number of lags on."""
    columns = values[:, None] if values.ndim == 1 else values
    return columns[_LAGS - lag : len(columns) - lag]
