"""Literals of a new best against the information that it gained on held-out data."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log2

import numpy as np

from asia.data.trajectory import Array
from asia.judge.scoring.bands import independent_errors
from asia.judge.scoring.outcome import without_gaps

SHARE = 0.1
"""Share of the gain that literals may take."""
FREE = 64.0
"""Bits of literals that are not asked about: some 19 digits."""


@dataclass(frozen=True)
class LiteralCheck:
    """Literals of a new best against the information that it gained."""

    since: int
    """Experiment that both are counted from."""
    bits: float
    """Literals that neither this experiment nor the model library has."""
    gain: float
    """Held-out log-likelihood gained, in bits."""
    guard: float | None = None
    """Error on the guard records, as in V; None without them, or where it was not asked for."""
    perturbed: float | None = None
    """Error of a fold, refitted with its literals perturbed, over the error before; None where it
    was not asked for, or could not be had."""
    suspect: str = ""
    """Reason to refuse the candidate; "" for none."""

    @property
    def affordable(self) -> bool:
        """Whether the literals take a tenth of the gain at most."""
        return self.bits <= max(FREE, SHARE * self.gain)


def gained_bits(
    y: Sequence[Sequence[Array]],
    before: Sequence[Sequence[Array]],
    after: Sequence[Sequence[Array]],
) -> float:
    """Return the gain in held-out log-likelihood, in bits.

    For Gaussian errors it is N / 2 log2(variance before / variance after), summed over folds and
    outputs. N is the number of independent errors: that of the samples over the sum of the
    autocorrelation up to its first zero crossing, of the errors before or after, whichever gives
    fewer. Slow errors cost few bits to copy, so few must be gained.

    Args:
        y: measured outputs (H, ny) of the held-out blocks of each fold.
        before, after: two simulations of them.
    """
    total = 0.0
    for measured, old, new in zip(y, before, after, strict=True):
        for output in range(measured[0].shape[1]):
            errors = [
                [
                    (without_gaps(a, b) - b)[:, output]
                    for a, b in zip(measured, simulated, strict=True)
                ]
                for simulated in (old, new)
            ]
            count = min(independent_errors([blocks]) for blocks in errors)
            power = [max(float(np.mean(np.concatenate(e) ** 2)), 1e-300) for e in errors]
            total += 0.5 * count * log2(power[0] / power[1])
    return total


def guard_gap(error: float, value: float) -> float:
    """log2 of the error on the guard records over V."""
    return log2(error / value) if error > 0 and value > 0 else 0.0
