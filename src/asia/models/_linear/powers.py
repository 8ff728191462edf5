"""Powers of the matrix A of a linear system, for convolutions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data import Array

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Powers:
    """Powers of A, and their transform."""

    values: Array
    """a^0, a^1, .. (T, n, n)."""
    spectrum: Spectrum
    """(frequencies, n, n)."""
    size: int
    """Length of the transform, enough for a convolution not to wrap around."""

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


def transform_size(samples: int) -> int:
    """Length of a fast Fourier transform whose convolution does not wrap around."""
    from scipy.fft import next_fast_len  # not needed by a simulation

    return next_fast_len(2 * samples, real=True)  # pyright: ignore[reportReturnType]
