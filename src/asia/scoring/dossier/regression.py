"""F test of regressors of a coloured residual, after whitening.

Source: Cochrane and Orcutt, Application of least squares regression to relationships containing
auto-correlated error terms, JASA 44 (1949), with an autoregression of several lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.data import Array

_ORDER = 8
_MOST_ROWS = 20_000
_PARTS = 6
_RANK = 1e-9


@dataclass(frozen=True)
class Explained:
    """Contribution of regressors beyond others."""

    chance: float
    """Probability that independent columns explain as much."""
    share: float
    """Share of the variance of the residual, corrected for the number of columns."""
    size: float
    """Standard deviation of the explained part, in the unit of the residual."""
    again: float
    """The share that they explain in each sixth of the samples with gains of the others; negative
    where chance explains nothing again, and 0 unless nearly every sixth has a gain."""


def explained(
    residual: Sequence[Array], base: Sequence[Array], added: Sequence[Array]
) -> Explained:
    """Test the contribution of `added` to a residual beyond `base` and a constant.

    Args:
        residual: (n,), one a block
        base, added: (n, columns), one a block
    """
    lengths = [len(e) for e in residual]
    if sum(lengths) > _MOST_ROWS:
        residual, base, added = _thinned(residual, base, added)
        lengths = [len(e) for e in residual]
    e = np.concatenate(list(residual))
    constant = np.ones((len(e), 1))
    x0 = _scaled(np.concatenate([constant, np.concatenate(list(base))], axis=1))
    x1 = _scaled(np.concatenate(list(added)))
    x = np.concatenate([x0, x1], axis=1)
    if x1.shape[1] == 0 or len(e) <= 2 * x.shape[1] or not np.any(e):
        return Explained(1.0, 0.0, 0.0, 0.0)
    bases = _bases(x0, x1)
    left0, left = _left(e, bases[0]), _left(e, bases[1])
    size = float(np.std(left0 - left))
    free = max(len(e) - bases[1].shape[1], 1)
    loss = float(left0 @ left0)
    kept = (float(left @ left) / free) / max(loss / max(len(e) - x0.shape[1], 1), 1e-300)
    filters = _autoregression(left, lengths)
    white = [_filtered(v, filters, lengths) for v in (e[:, None], x0, x1)]
    chance = _f_chance(white[0][:, 0], *_bases(white[1], white[2]))
    total = max(float(np.sum((e - e.mean()) ** 2)), 1e-300)
    share = max(0.0, 1.0 - kept) * min(loss / total, 1.0)
    return Explained(chance, share, size, _again(e, *bases))


def _bases(x0: Array, x1: Array) -> tuple[Array, Array]:
    """Orthonormal columns (n, r) that span those of x0, and those of both; the first ones of the
    second are those of the first. All fits to parts of the rows are then small and well posed."""
    base = _spanned(x0, x0)
    left = x1 - base @ (base.T @ x1)
    left -= base @ (base.T @ left)
    return base, np.concatenate([base, _spanned(left, x1)], axis=1)


def _spanned(columns: Array, before: Array) -> Array:
    """Return a basis of columns (n, c), whose values were `before` until others were projected
    out."""
    from scipy.linalg import qr  # only where statistics are asked for

    q, r = np.linalg.qr(columns)
    # Pivots are looked for in the small factor alone, which is much faster.
    found: Any = qr(r, pivoting=True)
    turned, ordered = found[:2]
    size = _RANK * float(np.sqrt(np.max(np.sum(before * before, axis=0), initial=0.0)))
    return q @ np.asarray(turned)[:, : int(np.sum(np.abs(np.diagonal(ordered)) > size))]


def _left(e: Array, basis: Array) -> Array:
    """Return the residual of a projection on the columns."""
    return e - basis @ (basis.T @ e)


def _again(e: Array, base: Array, whole: Array) -> float:
    sums, total, better = [0.0, 0.0], 0.0, 0
    for part in np.array_split(np.arange(len(e)), _PARTS):
        losses: list[float] = []
        for basis in (base, whole):
            own, many = basis[part], basis.shape[1]
            # Without the part: what it adds is taken off, and a column that is in it alone is not
            # known.
            others = np.eye(many) - own.T @ own
            gains = np.linalg.pinv(others, rcond=_RANK, hermitian=True) @ (
                basis.T @ e - own.T @ e[part]
            )
            left = e[part] - own @ gains
            losses.append(float(left @ left))
        sums = [a + b for a, b in zip(sums, losses, strict=True)]
        better += losses[1] < losses[0]
        total += float(np.sum((e[part] - e.mean()) ** 2))
    return (sums[0] - sums[1]) / max(total, 1e-300) if better >= _PARTS - 1 else 0.0


def _f_chance(e: Array, base: Array, whole: Array) -> float:
    from scipy.special import fdtrc  # only where statistics are asked for

    more, free = whole.shape[1] - base.shape[1], len(e) - whole.shape[1]
    if more <= 0 or free <= 0:
        return 1.0
    left0, left = _left(e, base), _left(e, whole)
    rest = float(left @ left)
    gain = float(left0 @ left0) - rest
    return float(fdtrc(more, free, max(gain, 0.0) / more / max(rest / free, 1e-300)))


def _autoregression(e: Array, lengths: Sequence[int]) -> Array:
    """Coefficients (order,) of e(t) on its own past, over all blocks; the order is shorter in short
    blocks."""
    order = max(0, min(_ORDER, min(lengths) // 4))
    rows, targets = [], []
    for part in _split(e, lengths):
        if len(part) > order > 0:
            lagged = np.lib.stride_tricks.sliding_window_view(part, order)[:-1, ::-1]
            rows.append(lagged)
            targets.append(part[order:])
    if not rows:
        return np.zeros(0)
    x, y = np.concatenate(rows), np.concatenate(targets)
    # A little ridge keeps a residual that is zero harmless.
    ridge = 1e-9 * float(np.sum(x * x)) / x.shape[1] + 1e-300
    return np.linalg.solve(x.T @ x + ridge * np.eye(order), x.T @ y)


def _filtered(x: Array, filters: Array, lengths: Sequence[int]) -> Array:
    """Whiten each column by subtracting its prediction from the past; the first samples of each
    block are dropped."""
    order = len(filters)
    parts: list[Array] = []
    for part in _split(x, lengths):
        left = part[order:].copy()
        for lag, value in enumerate(filters, start=1):
            left -= value * part[order - lag : len(part) - lag]
        parts.append(left)
    return np.concatenate(parts)


def _split(x: Array, lengths: Sequence[int]) -> list[Array]:
    return np.split(x, np.cumsum(lengths)[:-1])


def _scaled(x: Array) -> Array:
    """Columns of size 1, without those that do not move but the first constant."""
    size = np.sqrt(np.mean(x * x, axis=0))
    moves = np.ptp(x, axis=0) > 1e-9 * np.maximum(size, 1e-300)
    if x.shape[1]:
        moves[0] |= bool(np.all(x[:, 0] == 1.0))
    return x[:, moves] / size[moves]


def _thinned(*parts: Sequence[Array]) -> tuple[list[Array], ...]:
    """Blocks, evenly spread, or the middle of each where there are few, of `_MOST_ROWS` at most."""
    count = len(parts[0])
    longest = max(len(e) for e in parts[0])
    many = max(1, min(count, _MOST_ROWS // longest))
    places = np.linspace(0, count - 1, many).round().astype(int).tolist()
    each = _MOST_ROWS // many
    return tuple([p[k][:each] for k in places] for p in parts)
