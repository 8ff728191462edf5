"""Least squares on the output error at lines, which by Parseval is that of the steady state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.models._linear.periodic.lines import ExcitedLines, Spectrum
from asia.models._linear.periodic.modes import block_entries, readout, resolvent
from asia.models._linear.system import LinearSystem
from asia.models._solvers.progress import Progress

# Complex numbers of a piece of the Jacobian.
_PIECE = 4_000_000
_TINY = 1e-12


def with_inputs(lines: ExcitedLines, a: Array, c: Array) -> LinearSystem:
    """B and D by linear least squares, A in blocks and C given; the offset is zero."""
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
    theta = _solved(gram, cross.sum(axis=0).real.ravel(), _TINY).reshape(size, nu)
    return LinearSystem(a, theta[:n], c, theta[n:], np.zeros(ny))


def error(lines: ExcitedLines, system: LinearSystem) -> float:
    """Sum of squared output errors of the columns."""
    left = _left(lines, system)
    return float((abs(left) ** 2).sum())


def _left(lines: ExcitedLines, s: LinearSystem) -> Spectrum:
    return lines.y - (s.c @ resolvent(s.a, lines.z, s.b) + s.d) @ lines.u


@dataclass(frozen=True)
class LineRefinement:
    """Levenberg-Marquardt on B, C, D and the blocks of A."""

    iterations: int
    """Greatest number of steps."""
    damping: float = 1e-3
    """First damping, relative to the scaled normal matrix."""
    tolerance: float = 3e-4
    """Relative decrease of the cost below which it stops."""


def refined(
    lines: ExcitedLines, start: LinearSystem, how: LineRefinement, log: Progress | None = None
) -> LinearSystem:
    """A step to an unstable system is refused; log(iteration, root of the share left)."""
    system, cost, damping = start, error(lines, start), how.damping
    total = max(float((abs(lines.y) ** 2).sum()), 1e-300)
    for iteration in range(how.iterations):
        if log is not None:
            log(iteration, float(np.sqrt(cost / total)))
        system = _balanced(lines, system)
        normal, gradient = _normal(lines, system)
        proposal, proposed = system, cost
        while damping < 1e8:
            proposal = _moved(system, _solved(normal, gradient, damping))
            if abs(np.linalg.eigvals(proposal.a)).max() < 1.0:
                proposed = error(lines, proposal)
                if proposed < cost:
                    break
            damping *= 8.0
        if not proposed < cost:
            break
        settled = 1.0 - proposed / cost < how.tolerance
        system, cost, damping = proposal, proposed, max(0.2 * damping, 1e-9)
        if settled:
            break
    return system


def _solved(normal: Array, gradient: Array, damping: float) -> Array:
    scale = np.sqrt(np.diagonal(normal))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = normal / scale[:, None] / scale + damping * np.eye(len(normal))
    return np.linalg.solve(scaled, gradient / scale) / scale


def _balanced(lines: ExcitedLines, s: LinearSystem) -> LinearSystem:
    """Both states of a block scaled alike, to unit size."""
    states = resolvent(s.a, lines.z, s.b) @ lines.u
    power = (abs(states) ** 2).sum(axis=2).sum(axis=0)
    block = np.arange(s.order) // 2
    size = np.sqrt(np.bincount(block, power) / np.bincount(block))[block]
    return s.transformed(np.diag(1.0 / np.where(size > 1e-12, size, 1.0)))


def _normal(lines: ExcitedLines, s: LinearSystem) -> tuple[Array, Array]:
    rows, columns = block_entries(s.order)
    n, nu, ny = s.order, s.d.shape[1], len(s.c)
    count = len(rows) + n * nu + ny * n + ny * nu
    normal, gradient = np.zeros((count, count)), np.zeros(count)
    each = lines.u.shape[2] * ny * count
    eye = np.eye(ny)
    for piece in np.array_split(np.arange(len(lines.z)), 1 + len(lines.z) * each // _PIECE):
        z, u = lines.z[piece], lines.u[piece]
        x, w = resolvent(s.a, z, s.b) @ u, readout(s.a, z, s.c)
        residual = lines.y[piece] - s.c @ x - s.d @ u
        parts = [
            np.einsum("foi,fim->fomi", w[:, :, rows], x[:, columns]),
            np.einsum("foi,fjm->fomij", w, u),
            np.einsum("op,fjm->fompj", eye, x),
            np.einsum("op,fjm->fompj", eye, u),
        ]
        shape = (*residual.shape, -1)
        joined = np.concatenate([part.reshape(shape) for part in parts], axis=3)
        jacobian: Spectrum = joined.reshape(-1, count)
        real = np.concatenate([jacobian.real, jacobian.imag])
        normal += real.T @ real
        gradient += real.T @ np.concatenate([residual.real.ravel(), residual.imag.ravel()])
    return normal, gradient


def _moved(s: LinearSystem, step: Array) -> LinearSystem:
    rows, columns = block_entries(s.order)
    cuts = np.cumsum([len(rows), s.b.size, s.c.size])
    by_a, by_b, by_c, by_d = np.split(step, cuts)
    a = s.a.copy()
    a[rows, columns] += by_a
    return LinearSystem(
        a,
        s.b + by_b.reshape(s.b.shape),
        s.c + by_c.reshape(s.c.shape),
        s.d + by_d.reshape(s.d.shape),
        s.offset,
    )
