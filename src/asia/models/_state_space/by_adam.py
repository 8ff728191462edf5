"""Fit of a neural state-space model by Adam, with its map from past windows to states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._data.encoder import Encoder
from asia.models._data.records import ScaledData, window_size
from asia.models._networks.structure import Cell
from asia.models.methods import Adam


def encoded(
    params: dict[str, Any], start: Encoder, hidden: int, context: Context
) -> dict[str, Any]:
    """Add an encoder that starts as `start`, with `hidden` tanh functions without effect."""
    rng = np.random.default_rng(context.seed + 1)
    d = window_size(context)
    inner = rng.standard_normal((d, hidden)) / np.sqrt(max(d, 1))
    bend = {"inner": inner, "shift": rng.uniform(-1.0, 1.0, hidden)}
    outer = np.zeros((hidden, len(start.bias)))
    encoder = {"weights": start.weights, "bias": start.bias, **bend, "outer": outer}
    return {**params, "encoder": encoder}


def fit_by_adam(
    cell: Cell,
    params: dict[str, Any],
    records: ScaledData,
    context: Context,
    method: Adam,
    copies: int,
) -> Any:
    """Train in single precision."""
    from asia.models._networks.training import fit

    trained = fit(cell, _cast(params, np.float32), records, context, method, copies=copies)
    return _cast(trained, np.float64)


def fit_encoded(
    cell: Cell,
    params: dict[str, Any],
    records: ScaledData,
    context: Context,
    method: Adam,
    copies: int,
) -> tuple[dict[str, Any], Encoder]:
    """Train parameters with an encoder, which is returned separately."""
    trained = fit_by_adam(cell, params, records, context, method, copies)
    return trained, Encoder(**trained.pop("encoder"))


def _cast(tree: Mapping[str, Any], dtype: type[np.floating[Any]]) -> dict[str, Any]:
    return {
        name: _cast(v, dtype) if isinstance(v, Mapping) else np.asarray(v, dtype)
        for name, v in tree.items()
    }
