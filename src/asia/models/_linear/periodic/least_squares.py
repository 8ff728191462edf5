"""Least squares on the output error at lines, which by Parseval equals that of the steady state."""

from __future__ import annotations

from itertools import count

import numpy as np

from asia.data import Array
from asia.models._config import Progress
from asia.models._least_squares import (
    SEQUENTIAL,
    LevenbergMarquardt,
    NormalEquations,
    damped_step,
    minimise,
)
from asia.models._linear.periodic.lines import ExcitedLines, Spectrum
from asia.models._linear.periodic.modes import block_entries, readout, resolvent
from asia.models._linear.system import LinearSystem

# Complex numbers in one segment of the Jacobian.
_SEGMENT = 4_000_000
_TINY = 1e-12


def with_inputs(lines: ExcitedLines, a: Array, c: Array) -> LinearSystem:
    """Solve B and D by linear least squares, A in blocks and C given; the offset is zero."""
    n, ny, nu = len(a), len(c), lines.u.shape[1]
    eye = np.broadcast_to(np.eye(ny), (len(lines.z), ny, ny))
    left = np.concatenate([readout(a, lines.z, c), eye], axis=2)
    right = lines.u
    # Column (i, j) is left[:, i] right[j]: products of it are products of both factors' products.
    lefts = left.conj().swapaxes(1, 2) @ left
    rights = right.conj() @ right.swapaxes(1, 2)
    size = n + ny
    gram = (lefts.reshape(len(left), -1).T @ rights.reshape(len(left), -1)).real
    gram = gram.reshape(size, size, nu, nu).transpose(0, 2, 1, 3).reshape(size * nu, -1)
    cross = left.conj().swapaxes(1, 2) @ lines.y @ right.conj().swapaxes(1, 2)
    theta = damped_step(gram, -cross.sum(axis=0).real.ravel(), _TINY).reshape(size, nu)
    return LinearSystem(a, theta[:n], c, theta[n:], np.zeros(ny))


def error(lines: ExcitedLines, system: LinearSystem) -> float:
    """Sum of squared output errors of the columns."""
    s = system
    left = lines.y - (s.c @ resolvent(s.a, lines.z, s.b) + s.d) @ lines.u
    return float((abs(left) ** 2).sum())


def refined(
    lines: ExcitedLines,
    start: LinearSystem,
    method: LevenbergMarquardt,
    log: Progress | None = None,
) -> LinearSystem:
    """Refine B, C, D and the blocks of A by Levenberg-Marquardt.

    A step to an unstable system is refused. The sizes of the states do not matter: the damping is
    relative to each column of the Jacobian.

    Args:
        lines: excited lines.
        start: system at the start.
        method: settings.
        log: receives iteration and the root of the share left.
    """
    total, steps = max(float((abs(lines.y) ** 2).sum()), 1e-300), count()
    blocks = block_entries(start.order)
    theta0 = np.concatenate(
        [start.a[blocks], *(part.ravel() for part in (start.b, start.c, start.d))]
    )

    def system(theta: Array) -> LinearSystem:
        cuts = np.cumsum([len(blocks[0]), start.b.size, start.c.size])
        entries, b, c, d = np.split(theta, cuts)
        a = start.a.copy()
        a[blocks] = entries
        parts = (b.reshape(start.b.shape), c.reshape(start.c.shape), d.reshape(start.d.shape))
        return LinearSystem(a, *parts, start.offset)

    def cost(points: Array) -> Array:
        at = system(points[0, 0])
        stable = abs(np.linalg.eigvals(at.a)).max() < 1.0
        return np.array([[error(lines, at) if stable else np.inf]])

    def linearise(theta: Array) -> NormalEquations:
        square, normal, gradient = _normal(lines, system(theta[0]))
        if log is not None:
            log(next(steps), float(np.sqrt(square / total)))
        return NormalEquations(np.array([square]), normal[None], -gradient[None])

    return system(minimise(cost, linearise, theta0[None], method, SEQUENTIAL).theta[0])


def _normal(lines: ExcitedLines, s: LinearSystem) -> tuple[float, Array, Array]:
    """Sum of squares, normal matrix and gradient against it."""
    rows, columns = block_entries(s.order)
    n, nu, ny = s.order, s.d.shape[1], len(s.c)
    size = len(rows) + n * nu + ny * n + ny * nu
    square, normal, gradient = 0.0, np.zeros((size, size)), np.zeros(size)
    each = lines.u.shape[2] * ny * size
    eye = np.eye(ny)
    for segment in np.array_split(np.arange(len(lines.z)), 1 + len(lines.z) * each // _SEGMENT):
        z, u = lines.z[segment], lines.u[segment]
        x, w = resolvent(s.a, z, s.b) @ u, readout(s.a, z, s.c)
        residual = lines.y[segment] - s.c @ x - s.d @ u
        parts = [
            np.einsum("foi,fim->fomi", w[:, :, rows], x[:, columns]),
            np.einsum("foi,fjm->fomij", w, u),
            np.einsum("op,fjm->fompj", eye, x),
            np.einsum("op,fjm->fompj", eye, u),
        ]
        shape = (*residual.shape, -1)
        joined = np.concatenate([part.reshape(shape) for part in parts], axis=3)
        jacobian: Spectrum = joined.reshape(-1, size)
        real = np.concatenate([jacobian.real, jacobian.imag])
        normal += real.T @ real
        gradient += real.T @ np.concatenate([residual.real.ravel(), residual.imag.ravel()])
        square += float((abs(residual) ** 2).sum())
    return square, normal, gradient
