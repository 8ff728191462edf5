"""The top candidates of a finished search fitted again, and what that says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.scoring import ExpectedError, Interval, Outcome


@dataclass(frozen=True)
class Repeated:
    """A candidate fitted once more on every fold, from a seed that the evaluator chose."""

    experiment: int
    """1-based."""
    repeat: int
    """Number of the seed, 1-based, the same for all candidates; the search's own fit is none."""
    outcome: Outcome
    """Its score, or why there is none."""
    blocks: tuple[tuple[float, ...], ...] = ()
    """Contribution of each block of held-out samples to the score, one tuple a fold; () for a
    failure.
    """
    same: bool = False
    """True if every simulation is bitwise equal to that of the search, so that the seed has no
    effect.
    """
    seconds: float = 0.0
    """Duration."""
    event: Literal["repeated"] = "repeated"


@dataclass(frozen=True)
class ConfirmedCandidate:
    """One candidate with its repeated fits."""

    experiment: int
    """1-based."""
    first: float
    """V of the search's own fit, by which it was chosen."""
    value: Interval
    """V over the repeats alone; of a candidate whose fits do not depend on the seed, V of the
    search."""
    spread: float | None
    """Standard deviation of V over the repeats; 0 where fits do not depend on the seed, None where
    there are fewer than two."""
    repeats: int
    """Repeats that have a score."""
    failed: int
    """Repeats that failed."""
    deterministic: bool
    """True if fits do not depend on the seed."""
    best_rank: int
    """1 plus the candidates that are better, beyond doubt."""
    worst_rank: int
    """The number of candidates less those that are worse, beyond doubt."""


@dataclass(frozen=True)
class ConfirmedPair:
    """Two candidates against each other."""

    first: int
    """Experiment with the lower V."""
    second: int
    """Experiment with the higher V."""
    difference: Interval
    """V of the second less that of the first, over the same folds, blocks and seeds."""

    @property
    def apart(self) -> bool:
        """Return whether the first candidate is significantly better."""
        return self.difference.low > 0.0


@dataclass(frozen=True)
class Confirmed:
    """Result of repeated fits of the best candidates."""

    winner: int
    """The incumbent of the search."""
    seeds: int
    """Repeats of a candidate whose fits depend on the seed."""
    tried: int
    """Candidates with a score and a source of their own, which the winner was the best of."""
    level: float
    """The level at which all differences hold together."""
    candidates: tuple[ConfirmedCandidate, ...]
    """The lowest V first."""
    pairs: tuple[ConfirmedPair, ...]
    """Differences between all pairs of candidates."""
    noise: float | None
    """The noise floor: standard deviation of V over seeds, pooled over the candidates; None where
    it is not known."""
    expected: ExpectedError | None
    """The error to expect of the winner's fold models, as the search fitted them, on a new record,
    in the measure of V; None where it is not known."""
    expected_level: float = 0.9
    """The level of that interval."""
    ensemble: Interval | None = None
    """Expected score of the mean of the fold models' simulations, see `expected`; None if not
    known.
    """
    failed: tuple[int, ...] = ()
    """Experiments all of whose repeats failed; they are not ranked."""
    after_unsealing: bool = False
    """True if the sealed test had been opened before."""
    event: Literal["confirmed"] = "confirmed"
