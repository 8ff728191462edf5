"""Initial state from the past window, learned from a fitted model's own states.

A model simulated through its training records has a state at every sample; regressing these on
the past windows before them gives an estimate of the state that will simulate well from there,
with the noise of the window already weighed by the regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from asia.data import Array
from asia.models._arrays import AnyArray, namespace

Decomposed: TypeAlias = tuple[Array, Array]


@dataclass(frozen=True)
class Encoder:
    """Map from window features to a state: features weights + tanh(features inner + shift) outer +
    bias."""

    weights: Array
    """(d, n)."""
    bias: Array
    """(n,)."""
    inner: Array
    """(d, m)."""
    shift: Array
    """(m,)."""
    outer: Array
    """(m, n)."""

    def __call__(self, features: AnyArray) -> AnyArray:
        """Map (B, d) -> (B, n)."""
        bent = namespace(features).tanh(features @ self.inner + self.shift)
        return features @ self.weights + bent @ self.outer + self.bias


def affine(weights: Array, bias: Array) -> Encoder:
    """Make an encoder without tanh functions from weights (d, n) and bias (n,)."""
    inputs, outputs = weights.shape
    return Encoder(weights, bias, np.zeros((inputs, 0)), np.zeros(0), np.zeros((0, outputs)))


def fit_encoder(
    features: Sequence[Array],
    states: Sequence[Array],
    hidden: int = 0,
    seed: int = 0,
    regression: BlockedRidge | None = None,
) -> Encoder:
    """Ridge regression of states on features and on random tanh functions of them.

    The ridge and whether the tanh functions are used at all are chosen by prediction of
    contiguous blocks left out: neighbouring windows overlap, so leaving out single samples would
    choose too small a ridge.

    Args:
        features: (N_r, d) of each record.
        states: (N_r, n) of each record.
        hidden: number of tanh functions.
        seed: seed of the tanh functions.
        regression: regression on the features, if it is known.
    """
    x, y = np.concatenate(features), np.concatenate(states)
    if x.shape[1] == 0:
        return affine(np.zeros((0, y.shape[1])), y.mean(axis=0))
    plain, plain_error = (regression or BlockedRidge(x)).solved(y)
    without = affine(*plain)
    if hidden == 0:
        return without
    inner, shift = random_bend(x.shape[1], hidden, seed)
    both = BlockedRidge(np.concatenate([x, np.tanh(x @ inner + shift)], 1))
    (weights, bias), error = both.solved(y)
    if error >= plain_error:
        return without
    return Encoder(weights[: x.shape[1]], bias, inner, shift, weights[x.shape[1] :])


def random_bend(inputs: int, hidden: int, seed: int) -> tuple[Array, Array]:
    """Weights (inputs, hidden) and shifts (hidden,) of random tanh functions."""
    rng = np.random.default_rng(seed)
    inner = rng.standard_normal((inputs, hidden)) / np.sqrt(inputs)
    return inner, rng.uniform(-1.0, 1.0, hidden)


class BlockedRidge:
    """Ridge regressions on the same features x (N, d), the ridge chosen by contiguous blocks left
    out.

    The decompositions that do not depend on the target are computed once.
    """

    def __init__(self, x: Array) -> None:
        self._center = x.mean(axis=0)
        self._x = x - self._center
        self._ridges = ridges_for(len(x))

    def solved(self, y: Array) -> tuple[tuple[Array, Array], float]:
        """Solve for a target.

        Returns:
            Weights (d, n) and bias (n,), and the squared error of the blocks left out.
        """
        mean = y.mean(axis=0)
        y = y - mean
        errors, cross = np.zeros(len(self._ridges)), self._x.T @ y
        for (xb, decomposed), yb in zip(self._blocks, np.array_split(y, self._parts), strict=True):
            paths = _ridge_path(decomposed, cross - xb.T @ yb, self._ridges)
            errors += [float(((xb @ weights - yb) ** 2).sum()) for weights in paths]
        best = int(np.argmin(errors))
        (weights,) = _ridge_path(self._whole, cross, self._ridges[best : best + 1])
        return (weights, mean - self._center @ weights), float(errors[best])

    @property
    def _parts(self) -> int:
        return min(8, len(self._x))

    @cached_property
    def _gram(self) -> Array:
        return self._x.T @ self._x

    @cached_property
    def _whole(self) -> Decomposed:
        return _decomposed(self._gram)

    @cached_property
    def _blocks(self) -> list[tuple[Array, Decomposed]]:
        """Each block, and the decomposition without it."""
        parts = np.array_split(self._x, self._parts)
        return [(xb, _decomposed(self._gram - xb.T @ xb)) for xb in parts]


def ridges_for(samples: int) -> Array:
    """Ridges to choose from, for so many samples."""
    return np.logspace(-6, 3, 10) * max(samples / 1000, 1e-3)


def ridge_path(gram: Array, cross: Array, ridges: Array) -> list[Array]:
    """Weights (d, n) for each ridge.

    Args:
        gram: products of the features with themselves (d, d).
        cross: products of the features with the states (d, n).
        ridges: ridges.
    """
    return _ridge_path(_decomposed(gram), cross, ridges)


def _decomposed(gram: Array) -> Decomposed:
    values, vectors = np.linalg.eigh(gram)
    return np.maximum(values, 0.0), vectors


def _ridge_path(decomposed: Decomposed, cross: Array, ridges: Array) -> list[Array]:
    values, vectors = decomposed
    projected = vectors.T @ cross
    return [vectors @ (projected / (values + r)[:, None]) for r in ridges]
