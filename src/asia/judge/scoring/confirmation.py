"""Confirmation of a gain on records that nobody in the search could read.

In cross-validation each training record is the answer of some fold. Where an agent can read the
training records, a low V can be carried in by a source, or passed from fold to fold. A lower error
on the guard records cannot: no fold, candidate or agent has them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from asia.data.trajectory import Array, filled
from asia.judge.scoring.bands import independent_errors
from asia.judge.scoring.repeated_fits import (
    BLOCKS,
    Interval,
    RepeatedFits,
    block_values,
    paired_difference,
)

HALF: Final = 0.5
"""Share of the gain in V that must come back where nobody could read the answers."""
FAR_ABOVE_V: Final = 3.0
"""Error on other records over V, both normalised, from which on V is no measure of a model. On the
tests of 12 honest searches on six measured systems (the development zoo in benchmarks/RESULTS.md)
it is 0.83 to 2.3; in the two on `ph`, whose models fail on the test, 24 and 50."""
LEVEL: Final = 0.8
"""Level of the interval of a gain: each of its ends is passed by chance in one case of ten."""


@dataclass(frozen=True)
class Confirmation:
    """Gain of a new best, and what confirms it. Gains are shares of the error before."""

    since: int
    """Experiment that the gain is counted from; 0 for the training mean."""
    gain: float
    """Gain in V."""
    guard: Interval | None = None
    """Gain on the guard records, with an interval of level `LEVEL`; None without guard records."""
    sequential: float | None = None
    """Gain in V with the folds fitted one after the other; None where that was not asked."""
    apart: float | None = None
    """Error on the guard records over V, each relative to that of the first best: how far V ran
    away from the guard in all experiments together. None without guard records."""
    detail: str = ""
    """Failure of the candidate where it was asked; "" for none."""

    @property
    def confirmed(self) -> bool:
        """Whether every answer holds at least half of the gain, the one on the guard records
        differs from nothing by more than chance, and V did not run away from the guard."""
        if self.detail or self._ran_away:
            return False
        alone, guard, least = self.sequential, self.guard, HALF * self.gain
        holds = guard is None or (guard.value >= least and (guard.low > 0.0 or self.gain <= 0.0))
        return holds and (alone is None or alone >= least)

    @property
    def contradicted(self) -> bool:
        """Whether the guard records show, by more than chance, less than half of the gain, V ran
        away from the guard, or the candidate failed there."""
        less = self.guard is not None and self.guard.high < HALF * self.gain
        return less or self._ran_away or bool(self.detail)

    @property
    def _ran_away(self) -> bool:
        return self.apart is not None and self.apart > FAR_ABOVE_V


def share_gained(before: float, after: float) -> float:
    """Return the share by which an error fell."""
    return 1.0 - after / before if before > 0.0 else 0.0


@dataclass(frozen=True)
class ComparedParts:
    """Two simulations of the same measured samples, such as those that a fold holds out."""

    y: Sequence[Array]
    """Measured outputs (H, ny) of each block."""
    before: Sequence[Array]
    after: Sequence[Array]
    scale: Array
    """(ny,)."""

    @property
    def losses(self) -> list[Array]:
        """How much the squared error fell, (H,) of each block."""
        squares = [
            [
                np.sum((filled(a - b) / self.scale) ** 2, axis=1)
                for a, b in zip(self.y, each, strict=True)
            ]
            for each in (self.before, self.after)
        ]
        return [a - b for a, b in zip(*squares, strict=True)]


def paired_gain(parts: Sequence[ComparedParts], metric: str) -> Interval:
    """Return the share by which the error, its mean over the parts, fell from one simulation to
    another.

    The interval is that of the paired difference over blocks of the records, which are as many as
    there are independent differences of squared errors, `BLOCKS` a part at most (delete-a-block
    jackknife with Student's t; a bootstrap over so few blocks would be too narrow).
    """
    independent = independent_errors([part.losses for part in parts]) / len(parts)
    blocks = int(np.clip(independent, 2, BLOCKS))
    one, other = (
        RepeatedFits(np.array([[values.mean()]]), values[None, None])
        for values in (
            np.concatenate([
                block_values(p.y, getattr(p, name), p.scale, metric, blocks) for p in parts
            ])
            for name in ("before", "after")
        )
    )  # fmt: skip
    found = paired_difference(one, other, LEVEL)
    if one.value <= 0.0:
        return Interval(0.0, 0.0, 0.0)
    return Interval(found.value / one.value, found.low / one.value, found.high / one.value)
