"""Linear state-space systems in NumPy: simulation and its derivatives by fast convolution.

x[k+1] = A x[k] + B u[k],  y[k] = C x[k] + D u[k] + offset. The sensitivity of the output to an
entry of A or B is the response of C (zI - A)^-1 e_i to a state or an input, so all of them come
from one set of impulse responses (Ljung, System Identification, 2nd ed., section 10.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data import Array


@dataclass(frozen=True)
class LinearSystem:
    """A linear state-space system for z-scored signals."""

    a: Array
    """(n, n)."""
    b: Array
    """(n, nu)."""
    c: Array
    """(ny, n)."""
    d: Array
    """(ny, nu)."""
    offset: Array
    """(ny,)."""

    @property
    def order(self) -> int:
        """Number of states."""
        return self.a.shape[0]

    @property
    def radius(self) -> float:
        """Largest modulus of the poles."""
        return float(np.abs(np.linalg.eigvals(self.a)).max())

    def transformed(self, t: Array) -> LinearSystem:
        """The same system with states T x."""
        inverse = np.linalg.inv(t)
        return LinearSystem(t @ self.a @ inverse, t @ self.b, self.c @ inverse, self.d, self.offset)

    def simulate(self, x0: Array, u: Array) -> tuple[Array, Array]:
        """x0 (B, n), u (B, T, nu) -> states (B, T, n) and outputs (B, T, ny), by recursion."""
        drive = u @ self.b.T
        states = np.empty((*u.shape[:2], self.order))
        x = x0
        for k in range(u.shape[1]):
            states[:, k] = x
            x = x @ self.a.T + drive[:, k]
        return states, states @ self.c.T + u @ self.d.T + self.offset


def powers(a: Array, count: int) -> Array:
    """a^0 .. a^(count-1) as (count, n, n), by doubling."""
    result = np.empty((count, *a.shape))
    result[0] = np.eye(len(a))
    done, power = 1, a
    while done < count:
        more = min(done, count - done)
        result[done : done + more] = result[:more] @ power
        power = power @ power
        done += more
    return result


def delayed_convolution(kernel: Array, signals: Array) -> Array:
    """kernel (T, p, q), signals (T, s) -> (T, p, q, s): sum over k < t of kernel[t-1-k] s[k]."""
    length = len(signals)
    size = _transform_size(length)
    spectrum = np.fft.rfft(kernel, size, axis=0)[..., None]
    product = spectrum * np.fft.rfft(signals, size, axis=0)[:, None, None, :]
    full = np.fft.irfft(product, size, axis=0)[: length - 1]
    return np.concatenate([np.zeros((1, *full.shape[1:])), full])


def _transform_size(samples: int) -> int:
    """Length of a fast Fourier transform whose convolution does not wrap around."""
    from scipy.fft import next_fast_len  # not needed by a simulation

    return next_fast_len(2 * samples, real=True)  # pyright: ignore[reportReturnType]


def states_of(system: LinearSystem, power: Array, x0: Array, u: Array) -> Array:
    """u (T, nu) -> states (T, n); `power` holds a^k for k < T."""
    drive = u @ system.b.T
    size = _transform_size(len(u))
    spectrum = np.einsum(
        "fij,fj->fi", np.fft.rfft(power, size, axis=0), np.fft.rfft(drive, size, axis=0)
    )
    forced = np.fft.irfft(spectrum, size, axis=0)[: len(u) - 1]
    states = power @ x0
    states[1:] += forced
    return states
