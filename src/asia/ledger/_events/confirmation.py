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
    """How each block of a fold's held-out samples enters the score, one tuple a fold; () for a
    failure."""
    same: bool = False
    """Whether every simulation is bitwise that of the search: the seed plays no part."""
    seconds: float = 0.0
    """Duration."""
    event: Literal["repeated"] = "repeated"


@dataclass(frozen=True)
class ConfirmedCandidate:
    """One candidate after its repeats."""

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
    """Whether fits do not depend on the seed."""
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
        """Whether the first is better, beyond doubt."""
        return self.difference.low > 0.0


@dataclass(frozen=True)
class Confirmed:
    """What the repeats of the top candidates say."""

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
    """All pairs of candidates."""
    noise: float | None
    """The noise floor: standard deviation of V over seeds, pooled over the candidates; None where
    it is not known."""
    expected: ExpectedError | None
    """The error to expect of the winner's fold models, as the search fitted them, on a new record,
    in the measure of V; None where it is not known."""
    expected_level: float = 0.9
    """The level of that interval."""
    ensemble: Interval | None = None
    """As `expected`, of the mean of the fold models' simulations; None where it is not known."""
    failed: tuple[int, ...] = ()
    """Experiments all of whose repeats failed; they are not ranked."""
    after_unsealing: bool = False
    """Whether the sealed test had been opened before."""
    event: Literal["confirmed"] = "confirmed"
