"""Initial state from the past window, regressed on a model's own states."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, namespace
from asia.models._numerics.training_records import (
    Indices,
    ScaledData,
    past_length,
    past_windows_before,
    window_rows,
    window_size,
)

# Initial state from the past window, learned from a fitted model's own states.
#
# A model simulated through its training records has a state at every sample; regressing these on
# the past windows before them gives an estimate of the state that will simulate well from there,
# with the noise of the window already weighed by the regression.

Decomposed: TypeAlias = tuple[Array, Array]


@dataclass(frozen=True)
class Encoder:
    """Map from window features to a state: features weights + tanh(features inner + shift) outer +
    bias."""

    weights: Array  # (d, n)
    bias: Array  # (n,)
    inner: Array  # (d, m)
    shift: Array  # (m,)
    outer: Array  # (m, n)

    def __call__(self, features: AnyArray) -> AnyArray:
        """Map (B, d) -> (B, n)."""
        bent = namespace(features).tanh(features @ self.inner + self.shift)
        return features @ self.weights + bent @ self.outer + self.bias


def affine(weights: Array, bias: Array) -> Encoder:
    """Make an encoder without tanh functions from weights (d, n) and bias (n,)."""
    inputs, outputs = weights.shape
    return Encoder(weights, bias, np.zeros((inputs, 0)), np.zeros(0), np.zeros((0, outputs)))


def random_bend(inputs: int, hidden: int, seed: int) -> tuple[Array, Array]:
    """Weights (inputs, hidden) and shifts (hidden,) of random tanh functions."""
    rng = np.random.default_rng(seed)
    inner = rng.standard_normal((inputs, hidden)) / np.sqrt(inputs)
    return inner, rng.uniform(-1.0, 1.0, hidden)


def ridges_for(samples: int) -> Array:
    """Ridges to choose from, for so many samples."""
    return np.logspace(-6, 3, 10) * max(samples / 1000, 1e-3)


def _decomposed(gram: Array) -> Decomposed:
    values, vectors = np.linalg.eigh(gram)
    return np.maximum(values, 0.0), vectors


def _ridge_path(decomposed: Decomposed, cross: Array, ridges: Array) -> list[Array]:
    """Weights (d, n) for each ridge, from the products of features and states (d, n)."""
    values, vectors = decomposed
    projected = vectors.T @ cross
    return [vectors @ (projected / (values + r)[:, None]) for r in ridges]


# Numbers in the past windows above which they are not stored, and windows of a block.
_LONG, _BLOCK = 2_000_000, 4096
_PARTS = 8

StatesOf: TypeAlias = Callable[[int], Iterator[Array]]
"""States (T, n) of the blocks of a record, given its number, in time order."""
Pairs: TypeAlias = Callable[[], Iterator[tuple[Array, Array]]]
"""Iterations over features (N, d) and states (N, n), block by block and each time the same."""


def fit_encoder(
    features: Sequence[Array], states: Sequence[Array], hidden: int = 0, seed: int = 0
) -> Encoder:
    """Ridge regression of states (N_r, n) of each record on features (N_r, d) and on `hidden`
    random tanh functions of them.

    The ridge and whether the tanh functions are used at all are chosen by prediction of
    contiguous blocks left out: neighbouring windows overlap, so leaving out single samples would
    choose too small a ridge.
    """
    return _fitted(lambda: zip(features, states, strict=True), hidden, seed)


def window_encoder(
    records: ScaledData, states_of: StatesOf, context: Context, hidden: int = 0, seed: int = 0
) -> Encoder:
    """Map from a past window to the state, as `fit_encoder` finds it, from the states of each
    record, block by block."""
    past = past_length(context)
    long = [i for i, r in enumerate(records) if len(r) > past]
    rows = window_rows([records[i] for i in long], context)
    numbers = sum(len(records[i]) for i in long) * (window_size(context) + hidden)
    pairs = partial(_window_pairs, records, dict(zip(long, rows, strict=True)), states_of, context)
    if numbers > _LONG:
        return _fitted(pairs, hidden, seed)
    stored = list(pairs())
    return _fitted(lambda: iter(stored), hidden, seed)


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
                yield past_windows_before(records[i], some, context), states[some - first]
            first = stop


def _fitted(pairs: Pairs, hidden: int, seed: int) -> Encoder:
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
    """Weights (d, n), bias (n,) and the squared error of the parts left out, with the ridge that
    makes it least."""
    d, n = len(sums.x_mean), len(sums.y_mean)
    grams, crosses = np.zeros((_PARTS, d, d)), np.zeros((_PARTS, d, n))
    for part, x, y in sums.parts(pairs):
        grams[part] += x.T @ x
        crosses[part] += x.T @ y
    gram, cross, ridges = grams.sum(axis=0), crosses.sum(axis=0), ridges_for(sums.samples)
    paths = [
        np.stack(_ridge_path(_decomposed(gram - g), cross - c, ridges))
        for g, c in zip(grams, crosses, strict=True)
    ]
    errors = np.zeros(len(ridges))
    for part, x, y in sums.parts(pairs):
        errors += [float(((x @ weights - y) ** 2).sum()) for weights in paths[part]]
    best = int(np.argmin(errors))
    (weights,) = _ridge_path(_decomposed(gram), cross, ridges[best : best + 1])
    return weights, sums.y_mean - sums.x_mean @ weights, float(errors[best])
