"""Detection of integrating outputs: a pole at 1 in a linear model of block means."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from asia.agents._view import Facts
from asia.agents.library.records.same import SameRecords
from asia.data import Array

# Blocks of all records, lags of the model, and the least pole that counts: a time constant of a
# fifth of the records.
_BLOCKS, _LAGS, _LEAST_POLE, _LARGEST_POLE = 240, 3, 0.975, 1.05
_LEAST_SAMPLES = 60


def integrating(facts: Facts) -> tuple[int, ...]:
    """Numbers of the outputs that drift with the sum of the inputs and do not come back."""
    return _integrating(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _integrating(same: SameRecords) -> tuple[int, ...]:
    records = same.records
    samples = sum(len(r) for r in records)
    size = max(1, samples // _BLOCKS)
    pieces = [(_means(r.u, size), _means(r.y, size)) for r in records if len(r) // size > 4 * _LAGS]
    if sum(len(u) for u, _ in pieces) < _LEAST_SAMPLES:
        return ()
    outputs = range(pieces[0][1].shape[1])
    return tuple(k for k in outputs if _LEAST_POLE < _slowest(pieces, k) < _LARGEST_POLE)


def _means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


def _slowest(pieces: list[tuple[Array, Array]], output: int) -> float:
    """The greatest real pole of an autoregressive model with inputs, 0 where none is positive."""
    rows: list[Array] = []
    targets: list[Array] = []
    for u, every in pieces:
        y = every[:, output]
        past = [y[_LAGS - k : len(y) - k] for k in range(1, _LAGS + 1)]
        drive = [u[_LAGS - k : len(u) - k] for k in range(_LAGS + 1)]
        rows.append(np.column_stack([*past, *drive, np.ones(len(y) - _LAGS)]))
        targets.append(y[_LAGS:])
    x, y = np.concatenate(rows), np.concatenate(targets)
    spread = x.std(axis=0)
    x = x / np.where(spread > 0, spread, 1.0)
    theta = np.linalg.lstsq(x, y, rcond=1e-10)[0] / np.where(spread > 0, spread, 1.0)
    poles = np.roots([1.0, *-theta[:_LAGS]])
    real = poles.real[abs(poles.imag) < 0.02]
    return float(real.max(initial=0.0))
