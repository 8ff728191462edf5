"""Systems with an A of blocks of two states, and their response at lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.models._linear.periodic.lines import Spectrum

_LARGEST_RADIUS = 0.9999


def in_blocks(a: Array, c: Array) -> tuple[Array, Array] | None:
    """Transform (A, C) to coordinates in which A is block diagonal, with poles inside the unit
    circle.

    Outer poles are mirrored.

    Returns:
        None where the modes are too alike to be separated.
    """
    decomposed: Any = np.linalg.eig(a)
    poles: Spectrum = decomposed[0].astype(complex)
    vectors: Spectrum = decomposed[1].astype(complex)
    size = abs(poles)
    outside = size > _LARGEST_RADIUS
    size = np.where(outside, size, 1.0)
    poles = np.where(outside, poles / size * np.minimum(1.0 / size, _LARGEST_RADIUS), poles)
    pairs = np.flatnonzero(poles.imag > 0)
    real = np.flatnonzero(poles.imag == 0)
    blocks, t, at = np.zeros_like(a), np.zeros_like(a), 0
    for k in pairs:
        x, y = poles[k].real, poles[k].imag
        blocks[at : at + 2, at : at + 2] = [[x, y], [-y, x]]
        t[:, at], t[:, at + 1] = vectors[:, k].real, vectors[:, k].imag
        at += 2
    for k in real:
        blocks[at, at], t[:, at] = poles[k].real, vectors[:, k].real
        at += 1
    return (blocks, c @ t) if at == len(a) and np.isfinite(c @ t).all() else None


def block_entries(order: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the entries of A in its blocks."""
    block = np.arange(order) // 2
    rows, columns = np.nonzero(block[:, None] == block)
    return rows, columns


def resolvent(a: Array, z: Spectrum, b: Array) -> Spectrum:
    """Compute (zI - A)^-1 B (F, n, nu) of an A in blocks."""
    n = len(a)
    whole = n - n % 2
    i, j = np.arange(0, whole, 2), np.arange(1, whole, 2)
    p, q, r, s = a[i, i], a[i, j], a[j, i], a[j, j]
    at = z[:, None]
    inverse = 1.0 / ((at - p) * (at - s) - q * r)
    found = np.empty((len(z), n, b.shape[1]), complex)
    found[:, i] = ((at - s) * inverse)[..., None] * b[i] + (q * inverse)[..., None] * b[j]
    found[:, j] = (r * inverse)[..., None] * b[i] + ((at - p) * inverse)[..., None] * b[j]
    if whole < n:
        found[:, whole] = b[whole] / (at - a[whole, whole])
    return found


def readout(a: Array, z: Spectrum, c: Array) -> Spectrum:
    """Compute C (zI - A)^-1 (F, ny, n)."""
    return resolvent(a.T, z, c.T).swapaxes(1, 2)
