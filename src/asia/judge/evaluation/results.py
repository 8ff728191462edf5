"""Results of an evaluation."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from asia.candidate import ParameterEstimates
from asia.data.trajectory import Array
from asia.errors import CandidateError
from asia.judge.artifacts import ArtifactStore
from asia.judge.scoring.outcome import FoldRecord, Outcome, combine, score_fold
from asia.problem.folds import Fold


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one candidate on all folds, or on one of them."""

    outcome: Outcome
    output: str = ""
    """Text that the candidate printed during the first fold's fit, or that of a fold that failed,
    capped and stripped."""
    validation_scores: int = 0
    """Number of scores on held-out parts that the candidate requested, in all folds, failed ones
    included."""
    artifacts: ArtifactStore = field(default_factory=ArtifactStore, repr=False, compare=False)
    """The large parts of `folds`."""

    @property
    def folds(self) -> tuple[FoldRecord, ...]:
        """The records of all folds; empty if one of them failed."""
        return self.outcome.folds

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """Diagnostics that raised an exception, each line once, whatever the number of folds."""
        return tuple(dict.fromkeys(line for one in self.folds for line in one.failed))


def same_simulations(first: Sequence[FoldRecord], again: Sequence[FoldRecord]) -> bool:
    """Return whether every simulation came out bitwise the same."""
    return all(one.y_hat == other.y_hat for one, other in zip(first, again, strict=True))


@dataclass(frozen=True)
class RefitModel:
    """A model fitted on all training records."""

    model: bytes
    """The model; never parsed outside a sandbox."""
    estimates: ParameterEstimates | None = None
    """Parameter estimates of the model; None where it offers none."""


@dataclass(frozen=True)
class Refit:
    """A candidate fitted on all training records, and on one fold a second time."""

    model: RefitModel | CandidateError
    """The model fitted on all training records, or why there is none."""
    fold: int
    """The number of the fold that was fitted again, from 1."""
    again: Outcome
    """The outcome of that fold."""


def mean_simulation(each: Sequence[tuple[Array, ...] | CandidateError]) -> tuple[Array, ...]:
    """The mean over models of their simulations, one (H, ny) array a block. Raises the first
    CandidateError among them."""
    simulations: list[tuple[Array, ...]] = []
    for one in each:
        if isinstance(one, CandidateError):
            raise one
        simulations.append(one)
    return tuple(np.mean(np.stack(parts), axis=0) for parts in zip(*simulations, strict=True))


SUSPICIOUS_RATIO = 0.6
"""V over the training error, below which it takes more evidence. Honest candidates lie above
0.9."""


def consistency(value: float, training_errors: Sequence[float]) -> float:
    """V over the mean training error of the folds, both normalised by the same standard
    deviations."""
    train = float(np.mean(training_errors))
    return value / train if train > 0 else float("inf")


def derive_seed(root: int, *parts: object) -> int:
    """Derive a 31-bit seed from the search seed and a purpose, by sha256."""
    text = ":".join(str(p) for p in (root, *parts))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1


def score_outputs(
    folds: Sequence[Fold], outputs: Sequence[Sequence[Array]], metric: str
) -> Outcome:
    """Score given simulations, one (H, ny) array a held-out block of each fold."""
    scores = [
        score_fold([b.y for b in fold.held_out], y_hat, fold.scale, metric)
        for fold, y_hat in zip(folds, outputs, strict=True)
    ]
    return combine(scores)


POOR = 2.0
"""Training error of a fold, relative to the median of the other folds, from which on its fit
probably ended in a poor minimum."""
