"""Compiled part of a fit: the states of many simulations. All else is NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from asia.data.trajectory import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import (
    Scales,
    acting,
    effects,
    joined,
    outputs,
    simulate_states,
)

# Greatest number of states in the result of one call.
_MOST_VALUES = 1_000_000


class CompiledSimulator:
    """Simulator with one program of one shape: so many rows of so many segments, padded."""

    def __init__(self, structure: GreyBoxStructure, u: Array, rows: int) -> None:
        """Prepare the inputs (S, T, nu) of the segments; `rows` fits are simulated at a time."""
        self._structure, self._rows = structure, rows
        self._u = np.ascontiguousarray(u.transpose(1, 2, 0))
        each = u.shape[1] * structure.nx * rows
        self._width = int(np.clip(_MOST_VALUES // each, 1, len(u)))
        # Remove settings that the states do not depend on, which would cause another compilation.
        plain = replace(
            structure.config,
            ridge=0.0,
            residual_ridge=0.0,
            robust=None,
            initial=None,
            discover=(),
            intersample=None,
        )
        self._program = _compiled(replace(structure, config=plain))

    def __call__(self, z: Array, scales: Scales, x0: Array) -> tuple[Array, Array]:
        """Simulate P fits with coordinates z (P, size) from initial states x0 (P, S, nx): outputs
        (P, S, T, ny) and states (P, S, T, nx)."""
        parts = [self.piece(z, scales, x0, part) for part in self.pieces()]
        y, x = (np.concatenate(found, axis=1) for found in zip(*parts, strict=True))
        return y, x

    def pieces(self) -> Iterator[slice]:
        """Slices of the segments that one call simulates."""
        return _slices(self._u.shape[2], self._width)

    def piece(self, z: Array, scales: Scales, x0: Array, part: slice) -> tuple[Array, Array]:
        """Simulate the segments of one slice, as many fits at a time as the program has rows."""
        structure = self._structure
        columns = np.arange(part.start, part.start + self._width).clip(max=x0.shape[1] - 1)
        found: list[tuple[Array, Array]] = []
        for some in _slices(len(z), self._rows):
            rows = np.arange(some.start, some.start + self._rows).clip(max=len(z) - 1)
            own, start = scales.of_rows(rows), x0[rows][:, columns].transpose(2, 0, 1)
            effect = effects(structure, own, np.ascontiguousarray(z[rows].T))
            held = acting(structure, effect, self._u[:, :, columns])
            with jax.enable_x64(True):
                found_states, late = self._program(own, effect, start, held)
            states, late = np.asarray(found_states), None if late is None else np.asarray(late)
            y = outputs(structure, effect, states, joined(held, late))
            kept = slice(some.stop - some.start), slice(part.stop - part.start)
            found.append((y.transpose(2, 3, 0, 1)[kept], states.transpose(2, 3, 0, 1)[kept]))
        y, x = (np.concatenate(values) for values in zip(*found, strict=True))
        return y, x


def _slices(count: int, size: int) -> Iterator[slice]:
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


@lru_cache(maxsize=64)
def _compiled(structure: GreyBoxStructure) -> Any:
    """Compiled `simulate_states`."""
    return jax.jit(partial(simulate_states, structure))
