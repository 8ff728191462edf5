"""Initial state from the past window, learned from a fitted model's own states.

A model simulated through its training records has a state at every sample; regressing these on
the past windows before them gives an estimate of the state that will simulate well from there,
with the noise of the window already weighed by the regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array


@dataclass(frozen=True)
class Encoder:
    """state = features weights + tanh(features inner + shift) outer + bias."""

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

    def __call__(self, features: Array) -> Array:
        """(B, d) -> (B, n)."""
        bent = np.tanh(features @ self.inner + self.shift)
        return features @ self.weights + bent @ self.outer + self.bias


def affine(weights: Array, bias: Array) -> Encoder:
    """Without tanh functions: weights (d, n), bias (n,)."""
    return Encoder(weights, bias, *_no_bend(*weights.shape))


def fit_encoder(
    features: Sequence[Array], states: Sequence[Array], hidden: int = 0, seed: int = 0
) -> Encoder:
    """features (N_r, d) and states (N_r, n) of each record -> ridge regression on the features
    and on `hidden` random tanh functions of them.

    The ridge and whether the tanh functions are used at all are chosen by prediction of
    contiguous blocks left out: neighbouring windows overlap, so leaving out single samples would
    choose too small a ridge.
    """
    x, y = np.concatenate(features), np.concatenate(states)
    if x.shape[1] == 0:
        return affine(np.zeros((0, y.shape[1])), y.mean(axis=0))
    plain, plain_error = _regression(x, y)
    without = affine(*plain)
    if hidden == 0:
        return without
    rng = np.random.default_rng(seed)
    inner = rng.standard_normal((x.shape[1], hidden)) / np.sqrt(x.shape[1])
    shift = rng.uniform(-1.0, 1.0, hidden)
    (weights, bias), error = _regression(np.concatenate([x, np.tanh(x @ inner + shift)], 1), y)
    if error >= plain_error:
        return without
    return Encoder(weights[: x.shape[1]], bias, inner, shift, weights[x.shape[1] :])


def _no_bend(inputs: int, outputs: int) -> tuple[Array, Array, Array]:
    return np.zeros((inputs, 0)), np.zeros(0), np.zeros((0, outputs))


def _regression(x: Array, y: Array) -> tuple[tuple[Array, Array], float]:
    """Weights and bias, and the squared error of the blocks left out."""
    center, mean = x.mean(axis=0), y.mean(axis=0)
    x, y = x - center, y - mean
    ridges = np.logspace(-6, 3, 10) * max(len(x) / 1000, 1e-3)
    errors = np.zeros(len(ridges))
    gram, cross = x.T @ x, x.T @ y
    for block in np.array_split(np.arange(len(x)), min(8, len(x))):
        xb, yb = x[block], y[block]
        paths = _ridge_path(gram - xb.T @ xb, cross - xb.T @ yb, ridges)
        errors += [float(((xb @ weights - yb) ** 2).sum()) for weights in paths]
    best = int(np.argmin(errors))
    (weights,) = _ridge_path(gram, cross, ridges[best : best + 1])
    return (weights, mean - center @ weights), float(errors[best])


def _ridge_path(gram: Array, cross: Array, ridges: Array) -> list[Array]:
    values, vectors = np.linalg.eigh(gram)
    projected = vectors.T @ cross
    return [vectors @ (projected / (np.maximum(values, 0.0) + r)[:, None]) for r in ridges]
