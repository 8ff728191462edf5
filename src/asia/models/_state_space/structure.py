"""Equations of the neural state-space models, for NumPy and JAX arrays alike.

x[k+1] = A x + B v + f,  w = C x + D v + offset + g,  v = u + s(u),  y = w + r(w), where the
functions that a structure leaves out are zero, and those it has end in a layer that starts at
zero, so that the model starts as the linear one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asia.models._linear.system import LinearSystem
from asia.models._linear.windows import WindowLags, WindowPredictor

Nonlinearity = Literal["state", "input", "output", "both"]
Basis = Literal["tanh", "polynomial"]
Coefficients = Mapping[str, Any]

# Monomials are evaluated on signals of unit size limited to this, so that a simulation which
# leaves the training range grows linearly at most.
_RANGE = 4.0


@dataclass(frozen=True)
class StateSpaceStructure:
    """Sizes and kind of the functions; hashable. channels: None lets f and g read all of [x, v],
    a number only so many linear combinations of it. lags: None, or the state is the past window
    itself: its next value follows from the output, and f is left out."""

    order: int
    nu: int
    ny: int
    nonlinearity: Nonlinearity
    basis: Basis
    hidden: int
    degree: int
    channels: int | None
    lags: WindowLags | None = None

    def input(self, xp: ModuleType, p: Coefficients, u: Any) -> Any:
        """v from u (..., nu)."""
        return u + self._net(xp, p["s"], u) if "s" in p else u

    def split(self, xp: ModuleType, p: Coefficients, x: Any, v: Any) -> tuple[Any, Any]:
        """States x (..., n), inputs v (..., nu) -> next states and outputs before r."""
        output = x @ p["c"] + v @ p["d"] + p["offset"]
        if self.lags is not None:
            output = output + self._change(xp, p, x, v)
            keep, from_u, from_y = self.lags.shift()
            return x @ keep + v @ from_u + output @ from_y, output
        state = x @ p["a"] + v @ p["b"]
        if "f" not in p:
            return state, output
        change = self._change(xp, p, x, v)
        return state + change[..., : self.order], output + change[..., self.order :]

    def _change(self, xp: ModuleType, p: Coefficients, x: Any, v: Any) -> Any:
        both = xp.concatenate([x, v], axis=-1)
        if self.channels is None:
            return self._net(xp, p["f"], both)
        return self._net(xp, p["f"], both @ p["read"]) @ p["act"]

    def output(self, xp: ModuleType, p: Coefficients, w: Any) -> Any:
        """y from w (..., ny)."""
        return w + self._net(xp, p["r"], w) if "r" in p else w

    def _net(self, xp: ModuleType, p: Coefficients, z: Any) -> Any:
        if self.basis == "tanh":
            return xp.tanh(z @ p["w1"] + p["b1"]) @ p["w2"]
        z = xp.clip(z, -_RANGE, _RANGE)
        return xp.concatenate([z[..., i].prod(axis=-1) for i in self._monomials(z)], -1) @ p["w2"]

    def _monomials(self, z: Any) -> list[NDArray[np.intp]]:
        return [
            np.array(list(combinations_with_replacement(range(z.shape[-1]), d)))
            for d in range(2, self.degree + 1)
        ]

    def start_windowed(
        self, predictor: WindowPredictor, rng: np.random.Generator
    ) -> dict[str, Any]:
        """Parameters that simulate as the linear model whose state is the past window."""
        n, theta = self.order, predictor.theta
        p: dict[str, Any] = {"c": theta[:n], "d": theta[n:-1], "offset": theta[-1]}
        self._add_state_function(p, rng, self.ny)
        return p

    def start(self, system: LinearSystem, rng: np.random.Generator) -> dict[str, Any]:
        """Parameters that simulate as the linear system."""
        p: dict[str, Any] = {
            "a": system.a.T,
            "b": system.b.T,
            "c": system.c.T,
            "d": system.d.T,
            "offset": system.offset,
        }
        n, nu, ny = self.order, self.nu, self.ny
        if self.nonlinearity == "state":
            self._add_state_function(p, rng, n + ny)
        if self.nonlinearity in ("input", "both"):
            p["s"] = self._function(rng, nu, nu)
        if self.nonlinearity in ("output", "both"):
            p["r"] = self._function(rng, ny, ny)
        return p

    def _add_state_function(
        self, p: dict[str, Any], rng: np.random.Generator, outputs: int
    ) -> None:
        inputs, m = self.order + self.nu, self.channels
        if m is None:
            p["f"] = self._function(rng, inputs, outputs)
        else:
            p["f"] = self._function(rng, m, m)
            p["read"] = rng.standard_normal((inputs, m)) / np.sqrt(inputs)
            p["act"] = rng.standard_normal((m, outputs)) / np.sqrt(outputs)

    def _function(self, rng: np.random.Generator, inputs: int, outputs: int) -> dict[str, Any]:
        if self.basis == "polynomial":
            size = sum(len(i) for i in self._monomials(np.zeros(inputs)))
            return {"w2": np.zeros((size, outputs))}
        return {
            "w1": rng.standard_normal((inputs, self.hidden)) / np.sqrt(inputs),
            "b1": rng.uniform(-1.5, 1.5, self.hidden),
            "w2": np.zeros((self.hidden, outputs)),
        }

    def simulate(self, p: Coefficients, x0: NDArray[Any], u: NDArray[Any]) -> tuple[Any, Any]:
        """x0 (B, n), u (B, T, nu) -> states (B, T, n) and outputs (B, T, ny), in NumPy."""
        v = self.input(np, p, u)
        states = np.empty((*u.shape[:2], self.order))
        outputs = np.empty((*u.shape[:2], self.ny))
        x: Any = x0
        for k in range(u.shape[1]):
            states[:, k] = x
            x, outputs[:, k] = self.split(np, p, x, v[:, k])
        return states, self.output(np, p, outputs)
