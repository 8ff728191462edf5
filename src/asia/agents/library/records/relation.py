"""Relation of inputs and outputs in the training records: effect of the inputs, delay, feedback
from outputs to inputs, and instability.

Correlations are those of innovations, the part of a signal that its own past does not predict.
Source: L. D. Haugh, Checking the independence of two covariance-stationary time series, J. Am.
Stat. Assoc. 71, 1976.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from asia.agents._view import Facts
from asia.agents.library.records.same import SameRecords
from asia.data import Array, Trajectory

_OWN_LAGS, _MOST_SAMPLES, _FAR = 10, 20_000, 400
# Chance of an effect where there is none, over all lags and signals; a correlation below which one
# is of no use to a model; and one of inputs with past outputs below which there need be no loop.
_LEVEL, _LEAST, _LEAST_BACK = 0.01, 0.05, 0.15
# A signal whose past predicts it to this share of its standard deviation holds nothing new.
_PREDICTABLE = 0.02
# Blocks of all records, their lags, and the share of an error that inputs take away by more than
# chance.
_BLOCKS, _BLOCK_LAGS, _LEAST_GAIN = 240, 4, 0.03
# A mode that grows this much over the records.
_GROWTH = 100.0


@dataclass(frozen=True)
class Relation:
    """Relation of inputs and outputs in the training records."""

    effect: float
    """Greatest correlation of an output's innovation with those of the inputs or of their squares;
    0 where it is not significant, or where the inputs are too regular to tell."""
    delay: int
    """Samples after which inputs act first; 0 where there is no such correlation."""
    feedback: float
    """Greatest correlation of an input with past outputs; 0 where it may be chance, or where the
    inputs are too regular to tell."""
    pole: float
    """Greatest modulus of the poles of a linear one-step model."""
    reach: int
    """Greatest lag in samples that was looked at."""
    length: int
    """Samples of the longest record."""
    gain: float
    """Share of the error of one step, on samples left out, that inputs and their squares take
    away from that of past outputs alone."""

    @property
    def acts(self) -> bool:
        """Whether an effect of an input is seen."""
        return self.effect > 0.0 or self.gain > _LEAST_GAIN

    @property
    def unstable(self) -> bool:
        """Whether a growing mode makes a free simulation diverge."""
        return self.pole**self.length > _GROWTH


def relation(facts: Facts) -> Relation:
    """The one of the training records."""
    return _relation(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _relation(same: SameRecords) -> Relation:
    most = max(_MOST_SAMPLES // len(same.records), 20 * _OWN_LAGS)
    records = [r[:most] for r in same.records]
    length = max(map(len, records))
    reach = min(_FAR, length // 4)
    usable = [r for r in records if len(r) > reach + 2 * _OWN_LAGS]
    outputs = [_news(usable, lambda r, k=k: r.y[:, k]) for k in range(records[0].y.shape[1])]
    inputs = range(records[0].u.shape[1])
    plain = [_news(usable, lambda r, j=j: r.u[:, j]) for j in inputs]
    squares = [_news(usable, lambda r, j=j: (r.u[:, j] - r.u[:, j].mean()) ** 2) for j in inputs]
    known = [y for y in outputs if y is not None]
    ahead = [(y, u) for y in known for u in (*plain, *squares) if u is not None]
    back = [(u, y) for u in plain if u is not None for y in known]
    lag, effect = _strongest(ahead, range(reach + 1))
    _, feedback = _strongest(back, range(1, 2 * _OWN_LAGS + 1))
    return Relation(
        effect=effect,
        delay=lag,
        feedback=feedback if feedback >= _LEAST_BACK else 0.0,
        pole=max((_largest_pole(usable, k) for k in range(len(outputs))), default=0.0),
        reach=reach,
        length=max(map(len, same.records)),
        gain=max((_gain(usable, k) for k in range(len(outputs))), default=0.0),
    )


def _news(
    records: Sequence[Trajectory], read: Callable[[Trajectory], Array]
) -> tuple[Array, ...] | None:
    """Return the normalised innovation of each record's signal; None where it is close to zero."""
    signals = [read(r) for r in records]
    if not signals:
        return None
    size = float(np.concatenate(signals).std())
    if size <= 0:
        return None
    past = np.concatenate([_lagged(s / size) for s in signals])
    target = np.concatenate([s[_OWN_LAGS:] / size for s in signals])
    theta = np.linalg.lstsq(past, target, rcond=1e-10)[0]
    news = [s[_OWN_LAGS:] / size - _lagged(s / size) @ theta for s in signals]
    left = float(np.concatenate(news).std())
    return tuple(n / left for n in news) if left > _PREDICTABLE else None


def _lagged(signal: Array) -> Array:
    """(T - lags, lags + 1): past samples and a constant."""
    rows = len(signal) - _OWN_LAGS
    columns = [signal[_OWN_LAGS - k : _OWN_LAGS - k + rows] for k in range(1, _OWN_LAGS + 1)]
    return np.column_stack([*columns, np.ones(rows)])


def _strongest(
    pairs: Sequence[tuple[tuple[Array, ...], tuple[Array, ...]]], lags: range
) -> tuple[int, float]:
    """The first lag with at least half of the greatest correlation of (a, b delayed), and that
    correlation; (0, 0.0) where it may be chance."""
    found: list[tuple[float, int, float]] = []
    for a, b in pairs:
        samples = sum(map(len, a))
        for lag in lags:
            products = np.concatenate(
                [p[lag:] * q[: len(q) - lag] for p, q in zip(a, b, strict=True)]
            )
            # Held inputs are new at few samples: their correlations by chance are the larger.
            chance = float((products**2).sum()) ** 0.5 / samples
            found.append((abs(float(products.sum())) / samples, lag, chance))
    band = NormalDist().inv_cdf(1.0 - _LEVEL / (2 * max(len(found), 1)))
    sure = [(size, lag) for size, lag, chance in found if size > max(band * chance, _LEAST)]
    if not sure:
        return 0, 0.0
    greatest = max(sure)[0]
    return min(lag for size, lag in sure if size > 0.5 * greatest), greatest


def _gain(records: Sequence[Trajectory], output: int) -> float:
    """Return the gain in samples and in means of blocks: slow effects are hidden by the noise of
    single samples."""
    size = max(1, sum(map(len, records)) // _BLOCKS)
    return max(_gain_of_blocks(records, output, 1), _gain_of_blocks(records, output, size))


def _gain_of_blocks(records: Sequence[Trajectory], output: int, size: int) -> float:
    alone: list[Array] = []
    driven: list[Array] = []
    targets: list[Array] = []
    for record in records:
        y, u = _means(record.y[:, output : output + 1], size)[:, 0], _means(record.u, size)
        rows = len(y) - _BLOCK_LAGS
        if rows < 2:
            continue
        past = [y[_BLOCK_LAGS - k : _BLOCK_LAGS - k + rows] for k in range(1, _BLOCK_LAGS + 1)]
        inputs = np.hstack([u, (u - u.mean(axis=0)) ** 2])
        late = [inputs[_BLOCK_LAGS - k : _BLOCK_LAGS - k + rows] for k in range(_BLOCK_LAGS + 1)]
        alone.append(np.column_stack([*past, np.ones(rows)]))
        driven.append(np.column_stack([*past, *late, np.ones(rows)]))
        targets.append(y[_BLOCK_LAGS:])
    if not targets:
        return 0.0
    target = np.concatenate(targets)
    without = _left_out_error(np.concatenate(alone), target)
    return 1.0 - _left_out_error(np.concatenate(driven), target) / max(without, 1e-300)


def _left_out_error(x: Array, y: Array) -> float:
    """Root mean square error of each half by a linear model of the other."""
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    x, half, total = x / spread, len(y) // 2, 0.0
    for fitted, left in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
        theta = np.linalg.lstsq(x[fitted], y[fitted], rcond=1e-8)[0]
        total += float(((y[left] - x[left] @ theta) ** 2).sum())
    return (total / len(y)) ** 0.5


def _means(values: Array, size: int) -> Array:
    """Means (blocks, n) of blocks of so many samples."""
    blocks = len(values) // size
    return values[: blocks * size].reshape(blocks, size, -1).mean(axis=1)


def _largest_pole(records: Sequence[Trajectory], output: int) -> float:
    """Greatest modulus of the poles of linear one-step models of two orders: the lesser of both,
    because a model of too high an order has poles of its own."""
    return min((_pole_of_order(records, output, order) for order in (2, 4)), default=0.0)


def _pole_of_order(records: Sequence[Trajectory], output: int, order: int) -> float:
    rows: list[Array] = []
    targets: list[Array] = []
    for record in records:
        y = record.y[:, output]
        steps = range(1, order + 1)
        past = [y[order - k : len(y) - k] for k in steps]
        # Without the present input: in a loop it holds the present output.
        drive = [record.u[order - k : len(y) - k] for k in steps]
        rows.append(np.column_stack([*past, *drive, np.ones(len(y) - order)]))
        targets.append(y[order:])
    if not rows:
        return 0.0
    x = np.concatenate(rows)
    spread = np.where(x.std(axis=0) > 0, x.std(axis=0), 1.0)
    theta = np.linalg.lstsq(x / spread, np.concatenate(targets), rcond=1e-10)[0] / spread
    return float(abs(np.roots([1.0, *-theta[:order]])).max(initial=0.0))
