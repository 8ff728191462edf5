"""Response of a linear system on records and its derivatives, block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.models._linear.system import LinearSystem, Powers
from asia.models._noise.model import ErrorWeighting
from asia.models._numerics.training_records import ScaledData

# The sensitivity of the output to an entry of A or B is the response of C (zI - A)^-1 e_i to a
# state or an input, so all of them come from one set of impulse responses, by fast convolution
# (Ljung, System Identification, 2nd ed., section 10.3).
#
# A long record goes block by block, so that memory does not grow with its length: x[k] = A^k x[0] +
# the response to the inputs of the block, and the sensitivities likewise, as they obey the same
# recursion.

# Numbers in the derivatives above which records are processed in blocks, and those of one block.
_LONG, _BLOCK = 4_000_000, 500_000
_SHORTEST, _LONGEST = 1024, 16384
# Rounding of record lengths: records of the same rounded length share the transforms of a system.
_ROUNDED = 64


def numbers_of(order: int, nu: int, ny: int) -> int:
    """Count of the numbers that the derivatives of one sample take, with the transforms they are
    made by."""
    signals = order + nu
    return ny * (5 * order * signals + ny * signals)


class DrivenRecords:
    """Records, and the number of samples and outputs that count in them.

    `weightings`, one a record, belong to generalised least squares.
    """

    def __init__(
        self, records: ScaledData, weightings: Sequence[ErrorWeighting] | None = None
    ) -> None:
        self.records, self.weightings = records, weightings
        self.samples = sum(float((r.weight**2).sum()) for r in records)

    def response(self, system: LinearSystem, x0: Array) -> Response:
        """Response of the system from initial states x0 (R, n)."""
        return Response(self, system, x0)


@dataclass(frozen=True)
class Response:
    """States, residuals and normal equations of a system on records."""

    driven: DrivenRecords  # The records
    system: LinearSystem  # The system
    x0: Array  # Initial states (R, n)

    @cached_property
    def _counts(self) -> list[int]:
        """Samples of a block of each record: the whole record, but for long ones, which generalised
        least squares does not cut."""
        records, s = self.driven.records, self.system
        whole = [-(-len(r) // _ROUNDED) * _ROUNDED for r in records]
        each = max(numbers_of(s.order, s.b.shape[1], len(s.c)), 1)
        if self.driven.weightings is not None or sum(map(len, records)) * each <= _LONG:
            return whole
        size = 1 << max(_BLOCK // each, 1).bit_length() - 1
        return [min(count, int(np.clip(size, _SHORTEST, _LONGEST))) for count in whole]

    @cached_property
    def _powers(self) -> dict[int, Powers]:
        """Powers of A by the number of samples."""
        return {count: Powers.of(self.system.a, count) for count in set(self._counts)}

    @cached_property
    def _outputs(self) -> dict[int, tuple[Array, NDArray[np.complex128]]]:
        """C times the powers of A, and times their transform."""
        c = self.system.c
        return {n: (c @ p.values, (c @ p.spectrum)[..., None]) for n, p in self._powers.items()}

    @cached_property
    def _stored(self) -> dict[int, Array]:
        """States of the records that are one block."""
        return {}

    def states_of(self, i: int) -> Iterator[Array]:
        """Iterate over the states (T, n) of the blocks of a record, in time order."""
        if i in self._stored:
            yield self._stored[i]
            return
        record, system, x = self.driven.records[i], self.system, self.x0[i]
        powers = self._powers[self._counts[i]]
        for first in range(0, len(record), len(powers.values)):
            u = record.u[first : first + len(powers.values)]
            drive = np.fft.rfft(u, powers.size, axis=0) @ system.b.T
            forced = powers.delayed(np.einsum("fij,fj->fi", powers.spectrum, drive), len(u))
            states = powers.values[: len(u)] @ x + forced
            if len(states) == len(record):
                self._stored[i] = states
            yield states
            x = system.a @ states[-1] + system.b @ u[-1]

    def _blocks(self, i: int) -> Iterator[tuple[slice, Array, Array, Array]]:
        """Iterate over blocks: samples, states, measured minus simulated output (T, ny), and its
        weighted form; whitened where there are weightings."""
        record, s, first = self.driven.records[i], self.system, 0
        for states in self.states_of(i):
            rows = slice(first, first + len(states))
            first = rows.stop
            misfit = record.y[rows] - states @ s.c.T - record.u[rows] @ s.d.T - s.offset
            error = misfit
            if self.driven.weightings is not None:
                error = self.driven.weightings[i](misfit[None])[0]
            yield rows, states, misfit, record.weight[rows] * error

    def misfit(self, i: int) -> Array:
        """Measured minus simulated output of a record (T, ny)."""
        return np.concatenate([misfit for _, _, misfit, _ in self._blocks(i)])

    @cached_property
    def _sums(self) -> tuple[float, Array]:
        square, states = 0.0, np.zeros(self.system.order)
        with np.errstate(all="ignore"):
            for i in range(len(self.x0)):
                for _, x, _, residual in self._blocks(i):
                    square += float(residual.ravel() @ residual.ravel())
                    states += (x**2).sum(axis=0)
        return square, states

    @property
    def samples(self) -> float:
        """Squared weights of the records, summed over samples and outputs."""
        return self.driven.samples

    @property
    def square(self) -> float:
        """Sum of the squared weighted residuals."""
        return self._sums[0]

    @property
    def state_squares(self) -> Array:
        """Mean square of each state (n,)."""
        return self._sums[1] / sum(map(len, self.driven.records))

    @property
    def error(self) -> float:
        """Weighted mean squared simulation error over records and channels, infinite where it
        diverges."""
        error = self.square / max(self.samples, 1.0)
        return error if np.isfinite(error) else float("inf")

    def normal_equations(self, *, poles: bool = True) -> tuple[Array, Array]:
        """Products of the derivatives of the weighted outputs with themselves and with the weighted
        residuals. The derivatives are by A, B, C, D, the offset and the initial states of all
        records; without `poles` those by A and C are left out."""
        n, ny, nu = self.system.order, *self.system.d.shape
        core = n * nu + ny * nu + ny + (n + ny) * n * poles
        normal, gradient = np.zeros((core + self.x0.size,) * 2), np.zeros(core + self.x0.size)
        for i in range(len(self.x0)):
            own = np.r_[:core, core + i * n : core + (i + 1) * n]
            for slopes, residual in self.derivatives(i, poles=poles):
                normal[np.ix_(own, own)] += slopes.T @ slopes
                gradient[own] += slopes.T @ residual
        return normal, gradient

    def derivatives(self, i: int, *, poles: bool = True) -> Iterator[tuple[Array, Array]]:
        """Iterate over the derivatives (T ny, parameters) of the blocks of a record, with only its
        own initial state, and their weighted residuals."""
        record, n = self.driven.records[i], self.system.order
        powers, (outputs, kernel) = self._powers[self._counts[i]], self._outputs[self._counts[i]]
        signals = record.u.shape[1] + n * poles
        # Derivatives of the state at the start of a block: by the entries of [A B] or B, then by
        # x0.
        carried = np.concatenate([np.zeros((n, n * signals)), np.eye(n)], axis=1)
        for rows, states, misfit, residual in self._blocks(i):
            length, u = len(states), record.u[rows]
            z = np.concatenate([states, u], axis=1) if poles else u
            spectrum = np.fft.rfft(z, powers.size, axis=0)
            entries = powers.delayed(kernel * spectrum[:, None, None, :], length)
            initial = outputs[:length]
            if rows.start:
                free = outputs[:length] @ carried
                entries = free[..., :-n].reshape(entries.shape) + entries
                initial = free[..., -n:]
            parts = [entries[..., signals - u.shape[1] :]]
            parts = [entries[..., :n], *parts, states, u] if poles else [*parts, u]
            full = _joined(parts, initial)
            if self.driven.weightings is not None:
                full = self.driven.weightings[i].jacobian(misfit[None], full[None])[0]
            full *= record.weight[rows, :, None]
            yield full.reshape(full.shape[0] * full.shape[1], -1), residual.ravel()
            if rows.stop < len(record):
                carried = powers.values[length - 1] @ (self.system.a @ carried)
                driven = np.tensordot(powers.values[length - 1 :: -1], z, axes=(0, 0))
                carried[:, :-n] += driven.reshape(n, -1)


def _joined(parts: Sequence[Array], initial: Array) -> Array:
    """Derivatives (T, ny, parameters) from those by A and B, from the signals (T, m) that C and D
    multiply, and from those by the initial states (T, ny, n)."""
    length, ny = initial.shape[:2]
    eye = np.broadcast_to(np.eye(ny)[None, :, :, None], (length, ny, ny, 1))
    each = [part if part.ndim > 2 else eye * part[:, None, None, :] for part in parts]
    return np.concatenate([p.reshape(length, ny, -1) for p in (*each, eye, initial)], axis=2)
