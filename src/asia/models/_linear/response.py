"""Response of a linear system and its derivatives, whole or block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.models._linear.system import LinearSystem, Powers, Spectrum, transform_size
from asia.models._noise.model import ErrorWeighting
from asia.models._numerics.training_records import ScaledData

# Response of a linear system on long records, block by block.
#
# States and sensitivities are carried from one block to the next, so that memory does not grow
# with the length of the records. Each block is computed as in `asia.models._linear.response`. The
# initial state of a block acts through the powers of A: x[k] = A^k x[0] + the response to the
# inputs of the block, and the sensitivities likewise, as they obey the same recursion.

# Numbers in the derivatives above which records are processed in blocks, and those of one block.
_LONG, _BLOCK = 4_000_000, 500_000
_SHORTEST, _LONGEST = 1024, 16384


def numbers_of(order: int, nu: int, ny: int) -> int:
    """Count of the numbers that the derivatives of one sample take, with the transforms they are
    made by."""
    signals = order + nu
    return ny * (5 * order * signals + ny * signals)


@dataclass(frozen=True)
class LongResponse:
    """States, residuals and normal equations of a system on records, none of which is stored."""

    records: ScaledData  # The records
    samples: float  # Sum of the squared weights over samples and outputs
    system: LinearSystem  # The system
    x0: Array  # Initial states (R, n)

    @cached_property
    def _powers(self) -> Powers:
        s = self.system
        size = _BLOCK // max(numbers_of(s.order, s.b.shape[1], len(s.c)), 1)
        return Powers.of(s.a, int(np.clip(1 << max(size, 1).bit_length() - 1, _SHORTEST, _LONGEST)))

    def states_of(self, i: int) -> Iterator[Array]:
        """Iterate over the states (T, n) of the blocks of a record, in time order."""
        record, system, powers, x = self.records[i], self.system, self._powers, self.x0[i]
        for first in range(0, len(record), len(powers.values)):
            u = record.u[first : first + len(powers.values)]
            drive = np.fft.rfft(u, powers.size, axis=0) @ system.b.T
            forced = powers.delayed(np.einsum("fij,fj->fi", powers.spectrum, drive), len(u))
            states = powers.values[: len(u)] @ x + forced
            yield states
            x = system.a @ states[-1] + system.b @ u[-1]

    def _blocks(self, i: int) -> Iterator[tuple[slice, Array, Array]]:
        """Iterate over blocks: samples, states, and the weighted residual (T, ny)."""
        record, first = self.records[i], 0
        for states in self.states_of(i):
            rows = slice(first, first + len(states))
            first = rows.stop
            yield rows, states, record.weight[rows] * self._misfit(i, rows, states)

    def _misfit(self, i: int, rows: slice, states: Array) -> Array:
        record, s = self.records[i], self.system
        return record.y[rows] - states @ s.c.T - record.u[rows] @ s.d.T - s.offset

    def misfit(self, i: int) -> Array:
        """Measured minus simulated output of a record (T, ny)."""
        parts, first = list[Array](), 0
        for states in self.states_of(i):
            parts.append(self._misfit(i, slice(first, first + len(states)), states))
            first += len(states)
        return np.concatenate(parts)

    @cached_property
    def _sums(self) -> tuple[float, Array]:
        square, states = 0.0, np.zeros(self.system.order)
        with np.errstate(all="ignore"):
            for i in range(len(self.x0)):
                for _, x, residual in self._blocks(i):
                    square += float(residual.ravel() @ residual.ravel())
                    states += (x**2).sum(axis=0)
        return square, states

    @property
    def square(self) -> float:
        """Sum of the squared weighted residuals."""
        return self._sums[0]

    @property
    def state_squares(self) -> Array:
        """Mean square of each state (n,)."""
        return self._sums[1] / sum(len(r) for r in self.records)

    @property
    def error(self) -> float:
        """Weighted mean squared simulation error over records and channels, infinite where it
        diverges."""
        return _finite(self.square / max(self.samples, 1.0))

    def normal_equations(self, *, poles: bool = True) -> tuple[Array, Array]:
        """Normal equations as in `Response.normal_equations`."""
        n, ny, nu = self.system.order, *self.system.d.shape
        core = n * nu + ny * nu + ny + (n + ny) * n * poles
        normal, gradient = np.zeros((core + self.x0.size,) * 2), np.zeros(core + self.x0.size)
        for i in range(len(self.x0)):
            own = np.r_[:core, core + i * n : core + (i + 1) * n]
            for slopes, residual in self._slopes(i, poles):
                normal[np.ix_(own, own)] += slopes.T @ slopes
                gradient[own] += slopes.T @ residual
        return normal, gradient

    @cached_property
    def _outputs(self) -> tuple[Array, NDArray[np.complex128]]:
        """C times the powers of A, and times their transform."""
        c = self.system.c
        return c @ self._powers.values, (c @ self._powers.spectrum)[..., None]

    def _slopes(self, i: int, poles: bool) -> Iterator[tuple[Array, Array]]:
        """Derivatives (T ny, parameters) of the blocks of a record, with only its own initial
        state, and their weighted residuals."""
        record, powers, n = self.records[i], self._powers, self.system.order
        outputs, kernel = self._outputs
        signals = record.u.shape[1] + n * poles
        # Derivatives of the state at the start of a block: by the entries of [A B] or B, then by
        # x0.
        carried = np.concatenate([np.zeros((n, n * signals)), np.eye(n)], axis=1)
        for rows, states, residual in self._blocks(i):
            length, u = len(states), record.u[rows]
            z = np.concatenate([states, u], axis=1) if poles else u
            spectrum = np.fft.rfft(z, powers.size, axis=0)
            forced = powers.delayed(kernel * spectrum[:, None, None, :], length)
            free = outputs[:length] @ carried
            entries = free[..., :-n].reshape(forced.shape) + forced
            parts = [entries[..., signals - u.shape[1] :]]
            parts = [entries[..., :n], *parts, states, u] if poles else [*parts, u]
            full = _joined(parts, free[..., -n:])
            full *= record.weight[rows, :, None]
            yield full.reshape(full.shape[0] * full.shape[1], -1), residual.ravel()
            carried = powers.values[length - 1] @ (self.system.a @ carried)
            driven = np.tensordot(powers.values[length - 1 :: -1], z, axes=(0, 0))
            carried[:, :-n] += driven.reshape(n, -1)


def _finite(error: float) -> float:
    return error if np.isfinite(error) else float("inf")


def _joined(parts: Sequence[Array], initial: Array) -> Array:
    """Derivatives (T, ny, parameters) from those by A and B, from the signals (T, m) that C and D
    multiply, and from those by the initial states (T, ny, ...)."""
    length, ny = initial.shape[:2]
    eye = np.broadcast_to(np.eye(ny)[None, :, :, None], (length, ny, ny, 1))
    each = [part if part.ndim > 2 else eye * part[:, None, None, :] for part in parts]
    return np.concatenate([p.reshape(length, ny, -1) for p in (*each, eye, initial)], axis=2)


# Response of a linear system on training records, and its derivatives, by fast convolution.
#
# The sensitivity of the output to an entry of A or B is the response of C (zI - A)^-1 e_i to a
# state or an input, so all of them come from one set of impulse responses (Ljung, System
# Identification, 2nd ed., section 10.3). Transforms of the inputs are made once for a fit, those
# of the powers of A once for a system.

# Rounding of record lengths: records of the same rounded length share the transforms of a system.
_ROUNDED = 64


class DrivenRecords:
    """Records with the transforms of their inputs.

    `weightings`, one a record, belong to generalised least squares.
    """

    def __init__(
        self, records: ScaledData, weightings: Sequence[ErrorWeighting] | None = None
    ) -> None:
        self.records, self.weightings = records, weightings
        self.counts = [-(-len(r) // _ROUNDED) * _ROUNDED for r in records]
        self.samples = sum(float((r.weight**2).sum()) for r in records)

    @cached_property
    def spectra(self) -> list[Spectrum]:
        """Transforms of the inputs."""
        return [
            np.fft.rfft(r.u, transform_size(count), axis=0)
            for r, count in zip(self.records, self.counts, strict=True)
        ]

    def response(self, system: LinearSystem, x0: Array) -> Response:
        """Response of the system from initial states x0 (R, n)."""
        return Response(self, system, x0)

    def summed(self, system: LinearSystem, x0: Array) -> Response | LongResponse:
        """Response for sums over samples only: on long records block by block, except for
        generalised least squares."""
        each = numbers_of(system.order, system.b.shape[1], len(system.c))
        long = sum(len(r) for r in self.records) * each > _LONG
        if self.weightings is None and long:
            return LongResponse(self.records, self.samples, system, x0)
        return Response(self, system, x0)


@dataclass(frozen=True)
class Response:
    """States, residuals and derivatives of a system on records."""

    driven: DrivenRecords  # The records
    system: LinearSystem  # The system
    x0: Array  # Initial states (R, n)

    @cached_property
    def powers(self) -> dict[int, Powers]:
        """Powers of A by the number of samples."""
        return {count: Powers.of(self.system.a, count) for count in set(self.driven.counts)}

    @cached_property
    def states(self) -> list[Array]:
        """States (T, n) of each record."""
        found = list[Array]()
        for i, record in enumerate(self.driven.records):
            powers, length = self.powers[self.driven.counts[i]], len(record)
            drive = self.driven.spectra[i] @ self.system.b.T
            forced = powers.delayed(np.einsum("fij,fj->fi", powers.spectrum, drive), length)
            found.append(powers.values[:length] @ self.x0[i] + forced)
        return found

    def states_of(self, i: int) -> Iterator[Array]:
        """States (T, n) of a record, as its only block."""
        yield self.states[i]

    @property
    def state_squares(self) -> Array:
        """Mean square of each state (n,)."""
        return (np.concatenate(self.states) ** 2).mean(axis=0)

    @property
    def square(self) -> float:
        """Sum of the squared weighted residuals."""
        return float(self.residual @ self.residual)

    @property
    def samples(self) -> float:
        """Squared weights of the records, summed over samples and outputs."""
        return self.driven.samples

    @cached_property
    def residual(self) -> Array:
        """Weighted measured minus simulated output of all records, one after the other (samples *
        ny,); whitened where there are weightings."""
        found = list[Array]()
        with np.errstate(all="ignore"):
            for i, record in enumerate(self.driven.records):
                misfit = self.misfit(i)
                if self.driven.weightings is not None:
                    misfit = self.driven.weightings[i](misfit[None])[0]
                found.append((record.weight * misfit).ravel())
        return np.concatenate(found)

    def misfit(self, i: int) -> Array:
        """Measured minus simulated output of a record (T, ny)."""
        r, s = self.driven.records[i], self.system
        return r.y - self.states[i] @ s.c.T - r.u @ s.d.T - s.offset

    @property
    def error(self) -> float:
        """Weighted mean squared simulation error over records and channels, infinite where it
        diverges."""
        return _finite(self.square / max(self.samples, 1.0))

    def jacobian(self) -> Array:
        """Derivative of the weighted outputs (samples * ny, parameters): A, B, C, D, offset,
        initial states of all records."""
        return np.concatenate([self._derivatives(i, True) for i in range(len(self.x0))])

    def normal_equations(self, *, poles: bool = True) -> tuple[Array, Array]:
        """Products of the `jacobian` with itself and with the `residual`, record by record; without
        `poles` those of A and C are left out."""
        normal, gradient, first = np.zeros((1, 1)), np.zeros(1), 0
        for i in range(len(self.x0)):
            slopes = self._derivatives(i, poles)
            normal = normal + slopes.T @ slopes
            gradient = gradient + slopes.T @ self.residual[first : first + len(slopes)]
            first += len(slopes)
        return normal, gradient

    def _derivatives(self, i: int, poles: bool) -> Array:
        record, system = self.driven.records[i], self.system
        powers = self.powers[self.driven.counts[i]]
        length, ny = len(record), len(system.c)
        kernel = (system.c @ powers.spectrum)[..., None]

        def through(spectrum: Spectrum) -> Array:
            return powers.delayed(kernel * spectrum[:, None, None, :], length)

        initial = np.zeros((length, ny, *self.x0.shape))
        initial[:, :, i] = system.c @ powers.values[:length]
        parts = [through(self.driven.spectra[i]), record.u]
        if poles:
            states = self.states[i]
            by_a = through(np.fft.rfft(states, powers.size, axis=0))
            parts = [by_a, parts[0], states, record.u]
        full = _joined(parts, initial)
        if self.driven.weightings is not None:
            full = self.driven.weightings[i].jacobian(self.misfit(i)[None], full[None])[0]
        full *= record.weight[..., None]
        return full.reshape(length * ny, -1)
