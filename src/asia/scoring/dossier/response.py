"""The model as a linear one around operating points, from small steps of a simulator that may be
anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.scoring.dossier.check import Check, CheckCurve, Verdict
from asia.scoring.dossier.records import listed

SMALL = 1e-3
# Share of the largest singular value below which a state is not seen.
_SEEN = 1e-6
_MOST_STATES = 8
_MOST_ROWS = 60
_DECAYED = 1e-3
# With more outputs than these the sentence would be a table.
_MOST_GAINS = 3


@dataclass(frozen=True)
class LinearResponse:
    """Response of one model to a small impulse of one input around an operating point."""

    point: str
    """Operating point."""
    input: str
    """The input that moves."""
    impulse: Array
    """Change of the outputs (n, ny) for an input of 1 during the first sample."""

    @property
    def step(self) -> Array:
        """Change of the outputs (n, ny) for an input of 1 from the first sample on."""
        return np.cumsum(self.impulse, axis=0)

    @property
    def settled(self) -> bool:
        """Whether the response has decayed by the end."""
        tail = self.impulse[-max(1, len(self.impulse) // 10) :]
        return bool(
            np.max(np.abs(tail)) <= _DECAYED * max(float(np.abs(self.impulse).max()), 1e-300)
        )


def impulse_response(up: Array, down: Array, size: float) -> Array:
    """Estimate the impulse response.

    Args:
        up, down: simulations (n, ny) whose input is `size` above and below the operating point
            from the first sample on
    """
    step = (up - down) / (2.0 * size)
    return np.diff(step, axis=0, prepend=np.zeros((1, step.shape[1])))


def frequency_response_of(impulse: Array, omega: Array) -> NDArray[np.complex128]:
    """H(e^jw) (F, ny) of an impulse response (n, ny); omega (F,) in rad per sample."""
    times = np.arange(len(impulse))
    angles = np.outer(omega, times)
    return np.asarray(np.exp(-1j * angles) @ impulse, np.complex128)


def poles(impulse: Array) -> NDArray[np.complex128]:
    """The poles of the linear model with this impulse response (n, ny), the slowest first.

    Source: Kung, A new identification and model reduction algorithm via singular value
    decomposition, Asilomar 1978.
    """
    rows = min(_MOST_ROWS, (len(impulse) - 1) // 2)
    if rows < 2 or not np.any(impulse[1:]):
        return np.zeros(0, np.complex128)
    markov = impulse[1 : 2 * rows]
    hankel = np.concatenate([markov[k : k + rows].T.reshape(-1, rows) for k in range(rows)])
    u, values, _ = np.linalg.svd(hankel, full_matrices=False)
    order = min(_MOST_STATES, int(np.sum(values > _SEEN * values[0])))
    ny = impulse.shape[1]
    observability = u[:, :order] * np.sqrt(values[:order])
    a = np.linalg.lstsq(observability[:-ny], observability[ny:], rcond=None)[0]
    found = np.asarray(np.linalg.eigvals(a), np.complex128)
    return found[np.argsort(-np.abs(found), kind="stable")]


def check_responses(
    found: Sequence[LinearResponse], outputs: Sequence[str], sampling_time: float
) -> Check:
    """Static gains, slowest poles and step responses: shown."""
    name, axes = "poles and static gain", ("time [s]", "change for a step of 1")
    if not found:
        reason = "does not apply: the response of the model to small input steps is not finite"
        return Check(name, Verdict.ABSENT, reason)
    curves: list[CheckCurve] = []
    words: list[str] = []
    for one in found:
        times = np.arange(len(one.impulse), dtype=np.float64) * sampling_time
        for k, output in enumerate(outputs):
            curves.append(
                CheckCurve(f"{one.input} to {output}, {one.point}", times, one.step[:, k])
            )
        gains = [
            f"{value:.3g} on {output}"
            for value, output in zip(one.step[-1].tolist(), outputs, strict=True)
        ]
        slowest = poles(one.impulse)
        what = "static gain" if one.settled else "step response, not settled,"
        pole = f", slowest pole {_pole(slowest[0])}" if len(slowest) else ""
        if len(outputs) > _MOST_GAINS:
            gains = [f"of {len(outputs)} outputs in the curves"]
        words.append(f"{one.input} at {one.point}: {what} {listed(gains)}{pole}")
    return Check(name, Verdict.SHOWN, "; ".join(words), curves=tuple(curves), axes=axes)


def _pole(value: complex) -> str:
    if abs(value.imag) < 1e-9 * max(abs(value), 1e-300):
        return f"{value.real:.4g}"
    return f"{value.real:.4g} ± {abs(value.imag):.4g}j"
