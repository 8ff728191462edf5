"""Linear systems from the steady-state lines of periodic records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data.frequency import common_period
from asia.data.process import ROUNDING
from asia.data.trajectory import Array
from asia.models._config import Progress
from asia.models._least_squares import (
    SEQUENTIAL,
    LevenbergMarquardt,
    NormalEquations,
    damped_step,
    minimise,
)
from asia.models._linear.fit import Observability
from asia.models._linear.system import LinearSystem, Spectrum, unpacked
from asia.models._numerics.encoder import Encoder, fit_encoder
from asia.models._numerics.training_records import (
    Indices,
    ScaledData,
    past_length,
    past_windows_before,
    spread,
)

if TYPE_CHECKING:
    from asia.models.linear import Config

# Excited lines of periodic records, with all realisations compressed to few columns.

# Least amplitude of an excited input line, relative to the largest one.
_EXCITED = 1e-3
# Greatest difference of the periods in steady state, relative to the variance of an output.
_UNSTEADY = 0.1
# Least number of lines: fewer leave the response between them undetermined.
FEWEST_LINES = 30


@dataclass(frozen=True)
class ExcitedLines:
    """Excited lines, compressed so that least squares has the same solution as over all
    realisations.

    Only the part of the outputs that no linear system explains is left out.
    """

    z: Spectrum  # exp(j omega) of each line (F,)
    u: Spectrum  # Inputs (F, nu, m), at most nu columns
    y: Spectrum  # Outputs (F, ny, m)

    def part(self, which: NDArray[np.bool_]) -> ExcitedLines:
        """Select some of the lines."""
        return ExcitedLines(self.z[which], self.u[which], self.y[which])


@dataclass(frozen=True)
class SteadyRecord:
    """Mean period of a record."""

    u: Array  # (N, nu)
    y: Array  # (N, ny)
    first: int  # Sample of the record at which a period starts


def steady_records(records: ScaledData) -> list[SteadyRecord] | None:
    """Mean period of each record; None where no period occurs at least twice in all records, or
    where an output differs from period to period: no steady state, or too much noise."""
    period = common_period([r.u for r in records])
    if period is None or any((r.weight != 1).any() for r in records):
        return None
    found: list[SteadyRecord] = []
    for r in records:
        count = len(r) // period
        first = len(r) - count * period
        u, y = (v[first:].reshape(count, period, -1) for v in (r.u, r.y))
        apart = y.var(axis=0, ddof=1).mean(axis=0)
        if (apart > _UNSTEADY * np.maximum(y.var(axis=(0, 1)), 1e-12)).any():
            return None
        found.append(SteadyRecord(u.mean(axis=0), y.mean(axis=0), first))
    return found


def lines_of(records: Sequence[SteadyRecord]) -> ExcitedLines:
    """Excited lines of all records, without the constant."""
    period = len(records[0].u)
    scale, rows = np.sqrt(2.0) / period, slice(1, (period + 1) // 2)
    u, y = (
        np.stack([scale * np.fft.rfft(v, axis=0)[rows] for v in values], axis=-1)
        for values in ([r.u for r in records], [r.y for r in records])
    )
    size = abs(u).max(axis=(1, 2))
    excited = size > _EXCITED * size.max()
    z = np.exp(2j * np.pi * np.arange(rows.start, rows.stop) / period)[excited]
    nu, columns = u.shape[1:]
    both = np.concatenate([u, y], axis=1)[excited]
    if columns > nu:
        # A unitary change of columns leaves all inputs in the first nu.
        triangular: Any = np.linalg.qr(both.conj().swapaxes(1, 2), mode="r")
        both = triangular.conj().swapaxes(1, 2)[:, :, :nu]
    return ExcitedLines(z, both[:, :nu], both[:, nu:])


# Systems with an A of blocks of two states, and their response at lines.

_LARGEST_RADIUS = 0.9999


def in_blocks(a: Array, c: Array) -> tuple[Array, Array] | None:
    """Transform (A, C) to coordinates in which A is block diagonal, with outer poles mirrored into
    the unit circle; None where the modes are too alike to be separated."""
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


# Least squares on the output error at lines, which by Parseval equals that of the steady state.

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
    relative to each column of the Jacobian. The log receives iteration and the root of the share
    left.
    """
    total, steps = max(float((abs(lines.y) ** 2).sum()), 1e-300), count()
    blocks = block_entries(start.order)
    arrays = [start.a[blocks], start.b, start.c, start.d]
    shapes = [part.shape for part in arrays]
    theta0 = np.concatenate([part.ravel() for part in arrays])

    def system(theta: Array) -> LinearSystem:
        entries, b, c, d = unpacked(theta, shapes)
        a = start.a.copy()
        a[blocks] = entries
        return LinearSystem(a, b, c, d, start.offset)

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


# Frequency-domain subspace method: (A, C) from lines at any frequencies.

# Greatest number of columns, which are lines times realisations; the lines are spread over all.
_MOST_COLUMNS = 30_000


def observability(lines: ExcitedLines, max_order: int) -> Observability | None:
    """Observability matrix from Y_k z_k^i = C A^i X_k + (Markov parameters) U_k z_k^j, with the
    part that the inputs explain projected away; None where there are too few lines for any
    order."""
    columns = lines.u.shape[2]
    step = max(1, -(-len(lines.z) * columns // _MOST_COLUMNS))
    lines = lines.part(np.arange(len(lines.z)) % step == 0)
    nu, ny = lines.u.shape[1], lines.y.shape[1]
    most = len(lines.z) * columns // (nu + ny)
    blocks = min(2 * max_order // ny + 5, most)
    if blocks < 2:
        return None
    powers = lines.z[:, None] ** np.arange(blocks)
    stacked: list[Array] = []
    for spectrum in (lines.u, lines.y):
        rows = powers[:, :, None, None] * spectrum[:, None]
        rows = rows.transpose(1, 2, 0, 3).reshape(blocks * spectrum.shape[1], -1)
        stacked.append(np.concatenate([rows.real, rows.imag], axis=1))
    triangular: Any = np.linalg.qr(np.concatenate(stacked).T, mode="r")
    left, singular, _ = np.linalg.svd(triangular.T[blocks * nu :, blocks * nu :])
    keep = singular > 1e-12 * singular[0]
    return Observability(left[:, : len(keep)][:, keep] * np.sqrt(singular[keep]), ny)


# Fit of a linear system and its initial states to records with periodic inputs.

# Step of the lines left out while the order is chosen.
_EVERY = 3
# Limits on the past windows of the encoder: in numbers, and in windows.
_WINDOW_NUMBERS, _MOST_WINDOWS = 6_000_000, 20_000
# Relative step between orders that are tried.
_STEP = 0.12


def fit_periodic(
    records: ScaledData,
    context: Context,
    config: Config,
    iterations: int,
    log: Progress | None = None,
) -> tuple[LinearSystem, Encoder] | None:
    """Fit a system and the map from past windows to states; None where the records are not
    periodic, not in steady state or too short for the order."""
    steady = steady_records(records)
    if steady is None:
        return None
    lines = lines_of(steady)
    if len(lines.z) < FEWEST_LINES:
        return None
    order = config.order or _chosen_order(lines, config.periodic_order, config.tolerance)
    found = None if order is None else _started(lines, [order]).get(order)
    if found is None:
        return None
    method = LevenbergMarquardt(iterations, damping=1e-3, tolerance=3e-4)
    found = refined(lines, found, method, log)
    # The offset is the mean of the outputs without what the inputs explain.
    gain = found.gain
    left = [r.y.mean(axis=0) - gain @ r.u.mean(axis=0) for r in steady]
    found = replace(found, offset=np.mean(left, axis=0))
    # States (N, n) over the mean period of each record, scaled to unit mean square.
    states = list[Array]()
    for r in steady:
        period, spectrum = len(r.u), np.fft.rfft(r.u, axis=0)
        z = np.exp(2j * np.pi * np.arange(len(spectrum)) / period)
        response = resolvent(found.a, z, found.b) @ spectrum[:, :, None]
        states.append(np.fft.irfft(response[:, :, 0], period, axis=0))
    size = np.sqrt((np.concatenate(states) ** 2).mean(axis=0))
    scale = 1.0 / np.where(size > 1e-12, size, 1.0)
    # Map from a past window to the steady state, from windows spread over the records.
    past = past_length(context)
    width = max(1, context.n_past_u * context.nu + context.n_past_y * context.ny)
    most = min(_MOST_WINDOWS, _WINDOW_NUMBERS // width) // len(records) + 1
    rows: list[Indices] = [past + spread(len(r) - past, most) for r in records]
    features = [past_windows_before(r, at, context) for r, at in zip(records, rows, strict=True)]
    responses = [
        (x * scale)[(at - s.first) % len(x)] for x, at, s in zip(states, rows, steady, strict=True)
    ]
    return found.transformed(np.diag(scale)), fit_encoder(features, responses)


def _chosen_order(lines: ExcitedLines, max_order: int, tolerance: float) -> int | None:
    left_out = np.arange(len(lines.z)) % _EVERY == _EVERY // 2
    kept, left = lines.part(~left_out), lines.part(left_out)
    orders = [1]
    while orders[-1] < max_order:
        orders.append(min(max_order, orders[-1] + max(1, round(_STEP * orders[-1]))))
    found = _started(kept, orders)
    errors = {order: error(left, system) for order, system in found.items()}
    if not errors:
        return None
    limit = max(min(errors.values()), ROUNDING) * (1.0 + tolerance) ** 2
    return next(order for order, value in errors.items() if value <= limit)


def _started(lines: ExcitedLines, orders: Sequence[int]) -> dict[int, LinearSystem]:
    """Systems of these orders by the subspace method, as many as it gives."""
    factor = observability(lines, max(orders))
    found: dict[int, LinearSystem] = {}
    if factor is None:
        return found
    for order in orders:
        pair = factor.shifted(order)
        blocks = in_blocks(*pair) if pair is not None else None
        if blocks is not None:
            found[order] = with_inputs(lines, *blocks)
    return found
