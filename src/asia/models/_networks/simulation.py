"""Simulation of a network with given parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asia.models._networks.structure import (
    Cell,
    FeatureMap,
    NetworkStructure,
    Params,
    rollout,
    trace,
)

Float32 = NDArray[np.float32]


def outputs_of(cell: NetworkStructure, params: Params, window: Float32, u: Float32) -> Float32:
    """window (B, d), u (B, T, nu) -> outputs (B, T, ny), all z-scored."""
    with np.errstate(all="ignore"):
        return rollout(cell, params, window, u)


def features_of(cell: Cell | FeatureMap, params: Params, window: Float32, u: Float32) -> Float32:
    """Features (B, T, hidden) that the outputs are read from."""
    with np.errstate(all="ignore"):
        return trace(cell, params, window, u)
