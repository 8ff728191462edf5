"""Wiener-Hammerstein structure: linear system, static function, linear system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.data import Array
from asia.models._arrays import namespace
from asia.models._state_space.structure import Coefficients, StateSpaceStructure


@dataclass(frozen=True)
class WienerHammersteinStructure(StateSpaceStructure):
    """Equations x1[k+1] = A1 x1 + B1 u, v = C1 x1 + D1 u, w = v + f(v), x2[k+1] = A2 x2 + B2 w,
    y = C2 x2 + D2 w + offset."""

    first: int = 1
    """Number of states of x1; the rest are x2."""

    def split(self, p: Coefficients, x: Any, v: Any) -> tuple[Any, Any]:
        """Advance states x (..., n) with inputs v (..., nu); return the outputs too."""
        one, two = x[..., : self.first], x[..., self.first :]
        middle = one @ p["c1"] + v @ p["d1"]
        bent = middle + self._net(p["f"], middle)
        state = namespace(x).concatenate(
            [one @ p["a1"] + v @ p["b1"], two @ p["a2"] + bent @ p["b2"]], -1
        )
        return state, two @ p["c2"] + bent @ p["d2"] + p["offset"]

    def function(self, rng: np.random.Generator, size: int) -> dict[str, Any]:
        """Static function of `size` signals that is zero."""
        return self._function(rng, size, size)

    def features(self, function: dict[str, Any], signals: Array) -> Array:
        """Units or monomials (T, m) of signals (T, size)."""
        count = len(function["w2"])
        ones = {**function, "w2": np.eye(count)}
        return np.asarray(self._net(ones, signals), np.float64)
