"""Frequency-domain subspace method: (A, C) from lines at any frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np

from asia.data import Array
from asia.models._linear.periodic.lines import ExcitedLines
from asia.models._linear.subspace import Observability

# Greatest number of columns, which are lines times realisations; the lines are spread over all.
_MOST_COLUMNS = 30_000


def observability(lines: ExcitedLines, max_order: int) -> Observability | None:
    """Observability matrix from Y_k z_k^i = C A^i X_k + (Markov parameters) U_k z_k^j.

    The part that the inputs explain is projected away.

    Returns:
        None where there are too few lines for any order.
    """
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
