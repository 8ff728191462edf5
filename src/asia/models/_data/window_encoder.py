"""Regression of the initial state on the past window, from a model's own states on its records.

See `asia.models._data.encoder`; on long records it goes block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.models._data.cuts import Indices
from asia.models._data.encoder import (
    BlockedRidge,
    Encoder,
    affine,
    fit_encoder,
    random_bend,
    ridge_path,
    ridges_for,
)
from asia.models._data.records import (
    ScaledData,
    past_length,
    window_rows,
    window_size,
    windows,
    windows_before,
)

# Numbers in the past windows above which records are processed in blocks, and windows of a block.
_LONG, _BLOCK = 2_000_000, 4096
_PARTS = 8

StatesOf: TypeAlias = Callable[[int], Iterator[Array]]
"""States (T, n) of the blocks of a record, given its number, in time order."""
Pairs: TypeAlias = Callable[[], Iterator[tuple[Array, Array]]]
"""Iterations over features (N, d) and states (N, n), block by block and each time the same."""


def window_encoder(
    records: ScaledData,
    states_of: StatesOf,
    context: Context,
    hidden: int = 0,
    seed: int = 0,
    regression: BlockedRidge | None = None,
) -> Encoder:
    """Map from a past window to the state, as `fit_encoder` finds it.

    Args:
        records: records in z-scores.
        states_of: states of a record, block by block.
        context: context of the fit.
        hidden: number of tanh functions.
        seed: seed of the tanh functions.
        regression: regression on the past windows of these records, if it is known.
    """
    past = past_length(context)
    long = [i for i, r in enumerate(records) if len(r) > past]
    rows = window_rows([records[i] for i in long], context)
    numbers = sum(len(records[i]) for i in long) * (window_size(context) + hidden)
    if regression is None and numbers > _LONG:
        pairs = partial(
            _window_pairs, records, dict(zip(long, rows, strict=True)), states_of, context
        )
        return _fitted_by_blocks(pairs, hidden, seed)
    each = list(zip(long, rows, strict=True))
    return fit_encoder(
        [windows(records[i], context)[at] for i, at in each],
        [np.concatenate(list(states_of(i)))[past:][at] for i, at in each],
        hidden,
        seed,
        regression,
    )


def _window_pairs(
    records: ScaledData, rows: dict[int, Indices | slice], states_of: StatesOf, context: Context
) -> Iterator[tuple[Array, Array]]:
    past = past_length(context)
    for i, at in rows.items():
        first = 0
        for states in states_of(i):
            stop = first + len(states)
            chosen = np.arange(max(first, past), stop)
            if not isinstance(at, slice):
                begin, end = np.searchsorted(at, [first - past, stop - past])
                chosen = at[begin:end] + past
            for k in range(0, len(chosen), _BLOCK):
                some = chosen[k : k + _BLOCK]
                yield windows_before(records[i], some, context), states[some - first]
            first = stop


def _fitted_by_blocks(pairs: Pairs, hidden: int, seed: int) -> Encoder:
    """Fit an encoder as `fit_encoder` does, block by block."""
    d = next(pairs())[0].shape[1]
    plain = _Sums.of(pairs)
    if d == 0:
        return affine(np.zeros((0, len(plain.y_mean))), plain.y_mean)
    weights, bias, plain_error = _solved(pairs, plain)
    if hidden == 0:
        return affine(weights, bias)
    inner, shift = random_bend(d, hidden, seed)

    def both() -> Iterator[tuple[Array, Array]]:
        for x, y in pairs():
            yield np.concatenate([x, np.tanh(x @ inner + shift)], axis=1), y

    more, more_bias, error = _solved(both, _Sums.of(both))
    if error >= plain_error:
        return affine(weights, bias)
    return Encoder(more[:d], more_bias, inner, shift, more[d:])


class _Sums(NamedTuple):
    """Sums over features x and states y."""

    samples: int
    x_mean: Array
    y_mean: Array

    @classmethod
    def of(cls, pairs: Pairs) -> _Sums:
        count, x_sum, y_sum = 0, np.zeros(0), np.zeros(0)
        for x, y in pairs():
            if count == 0:
                x_sum, y_sum = np.zeros(x.shape[1]), np.zeros(y.shape[1])
            count, x_sum, y_sum = count + len(x), x_sum + x.sum(axis=0), y_sum + y.sum(axis=0)
        return cls(count, x_sum / count, y_sum / count)

    def parts(self, pairs: Pairs) -> Iterator[tuple[int, Array, Array]]:
        """Number of the part that is left out, and centred features and states in it."""
        size, longer = divmod(self.samples, _PARTS)
        ends = np.cumsum([size + (k < longer) for k in range(_PARTS)])
        first = 0
        for x, y in pairs():
            cuts = [e - first for e in ends.tolist() if first < e < first + len(x)]
            for a, b in pairwise([0, *cuts, len(x)]):
                part = int(np.searchsorted(ends, first + a, side="right"))
                yield part, x[a:b] - self.x_mean, y[a:b] - self.y_mean
            first += len(x)


def _solved(pairs: Pairs, sums: _Sums) -> tuple[Array, Array, float]:
    """Weights (d, n), bias (n,) and the squared error of the parts left out, as `BlockedRidge`."""
    d, n = len(sums.x_mean), len(sums.y_mean)
    grams, crosses = np.zeros((_PARTS, d, d)), np.zeros((_PARTS, d, n))
    for part, x, y in sums.parts(pairs):
        grams[part] += x.T @ x
        crosses[part] += x.T @ y
    gram, cross, ridges = grams.sum(axis=0), crosses.sum(axis=0), ridges_for(sums.samples)
    paths = [
        np.stack(ridge_path(gram - g, cross - c, ridges))
        for g, c in zip(grams, crosses, strict=True)
    ]
    errors = np.zeros(len(ridges))
    for part, x, y in sums.parts(pairs):
        errors += [float(((x @ weights - y) ** 2).sum()) for weights in paths[part]]
    best = int(np.argmin(errors))
    (weights,) = ridge_path(gram, cross, ridges[best : best + 1])
    return weights, sums.y_mean - sums.x_mean @ weights, float(errors[best])
