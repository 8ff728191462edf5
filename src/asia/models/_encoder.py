"""Initial state from the past window, learned from a fitted model's own states.

A model simulated through its training records has a state at every sample; regressing these on
the past windows before them gives an estimate of the state that will simulate well from there,
with the noise of the window already weighed by the regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.problem import Array


@dataclass(frozen=True)
class Encoder:
    """state = weights^T features + bias: weights (d, n), bias (n,)."""

    weights: Array
    bias: Array

    def __call__(self, features: Array) -> Array:
        """(B, d) -> (B, n)."""
        return features @ self.weights + self.bias


def fit_encoder(features: Sequence[Array], states: Sequence[Array]) -> Encoder:
    """features (N_r, d) and states (N_r, n) of each record -> ridge regression, the ridge chosen
    by leave-one-block-out prediction over contiguous blocks (neighbouring windows overlap, so
    leaving out single samples would choose too small a ridge)."""
    x, y = np.concatenate(features), np.concatenate(states)
    center, mean = x.mean(axis=0), y.mean(axis=0)
    if x.shape[1] == 0:
        return Encoder(np.zeros((0, y.shape[1])), mean)
    blocks = np.array_split(np.arange(len(x)), min(8, len(x)))
    ridges = np.logspace(-6, 3, 10)
    errors = np.zeros(len(ridges))
    if len(blocks) > 1:
        for block in blocks:
            kept = np.setdiff1d(np.arange(len(x)), block, assume_unique=True)
            for i, weights in enumerate(_ridge_path(x[kept] - center, y[kept] - mean, ridges)):
                errors[i] += float((((x[block] - center) @ weights - (y[block] - mean)) ** 2).sum())
    best = ridges[int(np.argmin(errors))]
    (weights,) = _ridge_path(x - center, y - mean, np.array([best]))
    return Encoder(weights, mean - center @ weights)


def _ridge_path(x: Array, y: Array, ridges: Array) -> list[Array]:
    values, vectors = np.linalg.eigh(x.T @ x)
    projected = vectors.T @ (x.T @ y)
    return [vectors @ (projected / (np.maximum(values, 0.0) + r)[:, None]) for r in ridges]
