"""Response of a linear system on training records, and its derivatives, by fast convolution.

The sensitivity of the output to an entry of A or B is the response of C (zI - A)^-1 e_i to a state
or an input, so all of them come from one set of impulse responses (Ljung, System Identification,
2nd ed., section 10.3). Transforms of the inputs are made once for a fit, those of the powers of A
once for a system.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from asia.data import Array
from asia.models._data.records import ScaledData
from asia.models._linear.long import LongResponse, are_long
from asia.models._linear.powers import Powers, Spectrum, transform_size
from asia.models._linear.system import LinearSystem
from asia.models._noise.weighting import ErrorWeighting

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
        self.samples = sum(float((r.weight**2).sum()) for r in records) * records[0].y.shape[1]

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
        if self.weightings is None and are_long(self.records, system.order):
            return LongResponse(self.records, self.samples, system, x0)
        return Response(self, system, x0)


@dataclass(frozen=True)
class Response:
    """States, residuals and derivatives of a system on records."""

    driven: DrivenRecords
    """The records."""
    system: LinearSystem
    """The system."""
    x0: Array
    """Initial states (R, n)."""

    @cached_property
    def powers(self) -> dict[int, Powers]:
        """Powers of A by the number of samples."""
        return {count: Powers.of(self.system.a, count) for count in set(self.driven.counts)}

    @cached_property
    def states(self) -> list[Array]:
        """States (T, n) of each record."""
        return [self._states(i) for i in range(len(self.x0))]

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

    def _states(self, i: int) -> Array:
        length, powers = len(self.driven.records[i]), self._powers(i)
        drive = self.driven.spectra[i] @ self.system.b.T
        forced = powers.delayed(np.einsum("fij,fj->fi", powers.spectrum, drive), length)
        return powers.values[:length] @ self.x0[i] + forced

    def _powers(self, i: int) -> Powers:
        return self.powers[self.driven.counts[i]]

    @cached_property
    def residual(self) -> Array:
        """Weighted measured minus simulated output of all records, one after the other (samples *
        ny,); whitened where there are weightings."""
        with np.errstate(all="ignore"):
            return np.concatenate([self._weighted(i).ravel() for i in range(len(self.x0))])

    def misfit(self, i: int) -> Array:
        """Measured minus simulated output of a record (T, ny)."""
        r, s = self.driven.records[i], self.system
        return r.y - self.states[i] @ s.c.T - r.u @ s.d.T - s.offset

    def _weighted(self, i: int) -> Array:
        found = self.misfit(i)
        if self.driven.weightings is not None:
            found = self.driven.weightings[i](found[None])[0]
        return self.driven.records[i].weight[:, None] * found

    @property
    def error(self) -> float:
        """Weighted mean squared simulation error over records and channels, infinite where it
        diverges."""
        error = self.square / max(self.samples, 1.0)
        return error if np.isfinite(error) else float("inf")

    def jacobian(self) -> Array:
        """Derivative of the weighted outputs (samples * ny, parameters): A, B, C, D, offset,
        initial states of all records."""
        return np.concatenate([self._derivatives(i, True) for i in range(len(self.x0))])

    def normal_equations(self, *, poles: bool = True) -> tuple[Array, Array]:
        """Products of the `jacobian` with itself and with the `residual`, record by record.

        Args:
            poles: include the columns of A and C.
        """
        normal, gradient, first = np.zeros((0, 0)), np.zeros(0), 0
        for i in range(len(self.x0)):
            slopes = self._derivatives(i, poles)
            if i == 0:
                normal, gradient = np.zeros((slopes.shape[1],) * 2), np.zeros(slopes.shape[1])
            rest = self.residual[first : first + len(slopes)]
            first += len(slopes)
            normal += slopes.T @ slopes
            gradient += slopes.T @ rest
        return normal, gradient

    def _derivatives(self, i: int, poles: bool) -> Array:
        record, powers, system = self.driven.records[i], self._powers(i), self.system
        length, ny = len(record), len(system.c)
        kernel = (system.c @ powers.spectrum)[..., None]

        def through(spectrum: Spectrum) -> Array:
            return powers.delayed(kernel * spectrum[:, None, None, :], length)

        eye = np.broadcast_to(np.eye(ny)[None, :, :, None], (length, ny, ny, 1))
        initial = np.zeros((length, ny, *self.x0.shape))
        initial[:, :, i] = system.c @ powers.values[:length]
        by_a, by_c = list[Array](), list[Array]()
        if poles:
            states = self.states[i]
            by_a = [through(np.fft.rfft(states, powers.size, axis=0))]
            by_c = [eye * states[:, None, None, :]]
        by_b, by_d = through(self.driven.spectra[i]), eye * record.u[:, None, None, :]
        parts: Sequence[Any] = [*by_a, by_b, *by_c, by_d, eye, initial]
        full = np.concatenate([part.reshape(length, ny, -1) for part in parts], axis=2)
        if self.driven.weightings is not None:
            full = self.driven.weightings[i].jacobian(self.misfit(i)[None], full[None])[0]
        full *= record.weight[:, None, None]
        return full.reshape(length * ny, -1)
