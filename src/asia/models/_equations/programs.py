"""The compiled part of a fit: simulations, and their derivatives by the coordinates and initial
states. All else is NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from asia.data import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Scales, simulate_states

# Numbers in the results of one call.
_MOST_VALUES = 4_000_000


class CompiledSimulator:
    """Simulations of segments by so many rows at a time; other numbers of rows are padded, because
    a program has one shape."""

    def __init__(self, structure: GreyBoxStructure, u: Array, rows: int) -> None:
        """u (S, T, nu): inputs of the segments."""
        # Settings that the simulation does not read would compile it again.
        plain = replace(structure.config, ridge=0.0, residual_ridge=0.0, robust=None, initial=None)
        self._structure = replace(structure, config=plain)
        self._u, self._rows = np.ascontiguousarray(u.transpose(1, 2, 0)), rows
        each = u.shape[1] * rows
        self._wide = self._pieces(each * (structure.nx + structure.ny))
        directions = structure.layout.size + structure.nx
        self._narrow = self._pieces(each * structure.ny * directions)

    def __call__(self, z: Array, scales: Scales, x0: Array) -> tuple[Array, Array]:
        """Outputs (K, S, T, ny) and states (K, S, T, nx) of K fits: coordinates z (K, size), their
        scales, initial states x0 (K, S, nx)."""
        (count, segments), samples = x0.shape[:2], len(self._u)
        y = np.empty((count, segments, samples, self._structure.ny))
        x = np.empty((count, segments, samples, self._structure.nx))
        for some in _slices(count, self._rows):
            for part in self._wide:
                values = self._call(_states, z, scales, x0, some, part)
                for target, found in zip((y, x), values, strict=True):
                    target[some, part] = _segments_first(found, target[some, part].shape)
        return y, x

    def derivatives(
        self, z: Array, scales: Scales, x0: Array
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Piece by piece the segments, outputs y (K, S, T, ny) and dy (K, S, T, ny, size + nx): by
        the coordinates and the segment's initial state; where that is measured, by the coordinates
        alone."""
        for part in self._narrow:
            found, by = self._call(_derivatives, z, scales, x0, slice(0, self._rows), part)
            shape = len(z), part.stop - part.start, len(self._u), self._structure.ny
            y = _segments_first(found, shape)
            if not len(by):
                yield part, y, np.empty((*shape, 0))
                continue
            dy = np.stack([_segments_first(one, shape) for one in by], axis=-1)
            yield part, y, dy

    def _call(
        self, program: Any, z: Array, scales: Scales, x0: Array, some: slice, part: slice
    ) -> tuple[Array, Array]:
        chosen = np.arange(some.start, some.start + self._rows).clip(max=len(z) - 1)
        size = self._width(program)
        columns = np.arange(part.start, part.start + size).clip(max=self._u.shape[2] - 1)
        with jax.enable_x64(True):
            found = program(self._structure)(
                z[chosen].T,
                scales.of_rows(chosen),
                x0[chosen][:, columns].transpose(2, 0, 1),
                self._u[:, :, columns],
            )
            return np.asarray(found[0]), np.asarray(found[1])

    def _width(self, program: Any) -> int:
        first = (self._wide if program is _states else self._narrow)[0]
        return first.stop - first.start

    def _pieces(self, values: int) -> list[slice]:
        """Slices of the segments, one of which gives so many values."""
        count = self._u.shape[2]
        return list(_slices(count, int(np.clip(_MOST_VALUES // values, 1, count))))


def _slices(count: int, size: int) -> Iterator[slice]:
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


def _segments_first(values: Array, shape: tuple[int, ...]) -> Array:
    """(T, n, R, S) with its padding -> (K, S, T, n)."""
    return values.transpose(2, 3, 0, 1)[: shape[0], : shape[1]]


@lru_cache(maxsize=64)
def _states(structure: GreyBoxStructure) -> Any:
    """Compiled `simulate_states`."""
    return jax.jit(lambda z, scales, x0, u: simulate_states(structure, scales, z, x0, u))


@lru_cache(maxsize=64)
def _derivatives(structure: GreyBoxStructure) -> Any:
    """Compiled: as `simulate_states` -> outputs (T, ny, R, S) and their derivatives (D, ...)."""

    def run(z: jax.Array, scales: Scales, x0: jax.Array, u: jax.Array) -> Any:
        size = len(z)
        count = size if structure.measured else size + structure.nx
        basis = np.eye(count, size + structure.nx)

        def along(direction: jax.Array) -> Any:
            tangents = (
                jax.numpy.broadcast_to(direction[:size, None], z.shape),
                jax.numpy.broadcast_to(direction[size:, None, None], x0.shape),
            )
            return jax.jvp(
                lambda z, x0: simulate_states(structure, scales, z, x0, u)[0], (z, x0), tangents
            )

        if not count:
            y = simulate_states(structure, scales, z, x0, u)[0]
            return y, jax.numpy.zeros((0, *y.shape))
        return jax.vmap(along, out_axes=(None, 0))(jax.numpy.asarray(basis))

    return jax.jit(run)
