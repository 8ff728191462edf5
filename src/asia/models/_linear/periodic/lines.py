"""Excited lines of periodic records, with all realisations compressed to few columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.data.frequency.periods import common_period
from asia.models._data.records import ScaledData

Spectrum = NDArray[np.complex128]
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

    z: Spectrum
    """exp(j omega) of each line (F,)."""
    u: Spectrum
    """Inputs (F, nu, m), at most nu columns."""
    y: Spectrum
    """Outputs (F, ny, m)."""

    def part(self, which: NDArray[np.bool_]) -> ExcitedLines:
        """Select some of the lines."""
        return ExcitedLines(self.z[which], self.u[which], self.y[which])


@dataclass(frozen=True)
class SteadyRecord:
    """Mean period of a record."""

    u: Array
    """(N, nu)."""
    y: Array
    """(N, ny)."""
    first: int
    """Sample of the record at which a period starts."""


def steady_records(records: ScaledData) -> list[SteadyRecord] | None:
    """Mean period of each record.

    Returns:
        None where no period occurs at least twice in all records, or where an output differs from
            period to period: no steady state, or too much noise.
    """
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
