"""Linear state-space systems: matrices and their powers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array

# Linear state-space systems: x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k] + offset.

# Samples that are simulated at a time.
_BLOCK = 65_536


@dataclass(frozen=True)
class LinearSystem:
    """Linear state-space system for z-scored signals."""

    a: Array  # (n, n)
    b: Array  # (n, nu)
    c: Array  # (ny, n)
    d: Array  # (ny, nu)
    offset: Array  # (ny,)

    @property
    def order(self) -> int:
        """Number of states."""
        return self.a.shape[0]

    @property
    def radius(self) -> float:
        """Largest modulus of the poles."""
        return float(np.abs(np.linalg.eigvals(self.a)).max())

    @property
    def matrices(self) -> tuple[Array, Array, Array, Array, Array]:
        """A, B, C, D and the offset."""
        return self.a, self.b, self.c, self.d, self.offset

    @property
    def gain(self) -> Array:
        """Static gain (ny, nu), infinite where a pole lies at 1."""
        try:
            return self.c @ np.linalg.solve(np.eye(self.order) - self.a, self.b) + self.d
        except np.linalg.LinAlgError:
            return np.full(self.d.shape, np.inf)

    def response(self, z: Spectrum) -> Spectrum:
        """Frequency response (F, ny, nu) at points z (F,) of the complex plane."""
        inside = z[:, None, None] * np.eye(self.order) - self.a
        return self.c @ np.linalg.solve(inside, self.b.astype(np.complex128)) + self.d

    def transformed(self, t: Array) -> LinearSystem:
        """Transform the states to T x."""
        inverse = np.linalg.inv(t)
        return LinearSystem(t @ self.a @ inverse, t @ self.b, self.c @ inverse, self.d, self.offset)

    def simulate(self, x0: Array, u: Array) -> tuple[Array, Array]:
        """Simulate by recursion from x0 (B, n) with inputs u (B, T, nu): states (B, T, n) and
        outputs (B, T, ny)."""
        drive = u @ self.b.T
        states = np.empty((*u.shape[:2], self.order))
        x = x0
        for k in range(u.shape[1]):
            states[:, k] = x
            x = x @ self.a.T + drive[:, k]
        return states, states @ self.c.T + u @ self.d.T + self.offset

    def outputs(self, x0: Array, drive: Callable[[int, int], Array], samples: int) -> Array:
        """Simulate only the outputs (B, T, ny) of T `samples` from x0 (B, n), block after block, so
        that no states of long simulations are stored; drive(first, stop) gives the inputs."""
        y, x = np.empty((len(x0), samples, len(self.c))), x0
        for first in range(0, samples, _BLOCK):
            stop = min(first + _BLOCK, samples)
            u = drive(first, stop)
            states, y[:, first:stop] = self.simulate(x, u)
            x = states[:, -1] @ self.a.T + u[:, -1] @ self.b.T
        return y


# Powers of the matrix A of a linear system, for convolutions.

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Powers:
    """Powers of A, and their transform."""

    values: Array  # a^0, a^1, .. (T, n, n)
    spectrum: Spectrum  # (frequencies, n, n)
    size: int  # Length of the transform, enough for a convolution not to wrap around

    @classmethod
    def of(cls, a: Array, count: int) -> Powers:
        """Compute the powers by doubling."""
        values = np.empty((count, *a.shape))
        values[0] = np.eye(len(a))
        done, power = 1, a
        while done < count:
            more = min(done, count - done)
            values[done : done + more] = values[:more] @ power
            power = power @ power
            done += more
        size = transform_size(count)
        return cls(values, np.fft.rfft(values, size, axis=0), size)

    def delayed(self, spectrum: Spectrum, length: int) -> Array:
        """Transform (frequencies, ...) back to the first `length` samples, one later than the
        product."""
        later = np.fft.irfft(spectrum, self.size, axis=0)[: length - 1]
        return np.concatenate([np.zeros((1, *later.shape[1:])), later])


def unpacked(theta: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Cut a vector into arrays of these shapes, one after the other."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    parts = np.split(theta, ends)
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def transform_size(samples: int) -> int:
    """Length of a fast Fourier transform whose convolution does not wrap around."""
    from scipy.fft import next_fast_len  # not needed by a simulation

    return next_fast_len(2 * samples, real=True)  # pyright: ignore[reportReturnType]
