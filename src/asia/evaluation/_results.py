"""What an evaluation gives."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from asia.candidate import ParameterEstimates
from asia.data import Array
from asia.errors import CandidateError
from asia.evaluation._training_checks import TrainingCheck
from asia.protocol import Fold
from asia.scoring import (
    Diagnostics,
    Failure,
    FoldScore,
    Outcome,
    SignedResidual,
    combine,
    score_fold,
)


@dataclass(frozen=True)
class StepErrors:
    """The errors on the held-out windows at one step."""

    step: int
    """The step within the window, from 1."""
    errors: tuple[float, ...]
    """The metric of each output, as it enters V."""


@dataclass(frozen=True)
class FoldFindings:
    """What is learned of the model of one fold beside its score."""

    errors: tuple[float, ...]
    """The metric of each output on the held-out part, as it enters V."""
    train_errors: tuple[float, ...]
    """The same on the training records."""
    steps: tuple[StepErrors, ...] = ()
    """The held-out errors at the steps that the protocol names; () for long simulations."""
    residuals: tuple[SignedResidual, ...] = ()
    """Of the simulation of the training records, the largest shares first."""
    parameters: tuple[tuple[str, float], ...] = ()
    """Names and values that the model offers."""
    compile_seconds: float = 0.0
    """How long JAX traced and compiled, in the fit and the simulations."""
    memory_mb: float | None = None
    """The largest address space of the worker; None where the system does not say."""
    printed: str = ""
    """What the candidate printed during the fit, its middle left out where it is long."""
    held_out_residuals: tuple[SignedResidual, ...] = ()
    """Of the simulation of the held-out part; () unless the protocol shows these."""
    checks: tuple[TrainingCheck, ...] | None = None
    """Those of `asia validate` that do not pass on the training records; None in older ledgers and
    where these checks failed."""
    failed: Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)] = ()
    """Diagnostics that raised an exception, a line each."""


@dataclass(frozen=True)
class FoldResult:
    """What the evaluation of one fold gives."""

    score: FoldScore
    """The errors on the held-out part."""
    model: bytes
    """The fitted model; never parsed outside a sandbox."""
    y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each held-out block."""
    curve: Array
    """Step and loss as logged by the candidate, (n, 2)."""
    diagnostics: Diagnostics
    """Residuals on the training records."""
    seconds: float
    """How long the fit took."""
    validation_scores: int = 0
    """How often the candidate asked for its score on the held-out part."""
    findings: FoldFindings | None = None
    """What is learned of the model beside its score."""
    machine: str = ""
    """The machine that fitted it; "" for the search's own."""
    isolation: str = ""
    """The level that was in force there; "" for the search's own."""
    device: str = ""
    """What JAX computed on, by the worker's own word; "" where nobody asked for a GPU."""


@dataclass(frozen=True)
class FoldEnd:
    """How the evaluation of one fold ended, also where it failed."""

    result: FoldResult | Failure
    """The result, or why there is none."""
    output: str
    """What the candidate printed."""
    validation_scores: int
    """How often it asked for its score on the held-out part."""


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one candidate."""

    outcome: Outcome
    """Its score, or why it failed."""
    folds: tuple[FoldResult, ...] = ()
    """The results of all folds; empty if one of them failed."""
    output: str = ""
    """What it printed during the first fold's fit, or that of a fold that failed, capped and
    stripped."""
    validation_scores: int = 0
    """How often it asked for its score on held-out parts, in all folds, failed ones included."""
    ended_folds: int = 0
    """How many folds were ended while they ran, since they did not count any more."""

    @property
    def y_hats(self) -> list[tuple[Array, ...]]:
        """The held-out simulations of each fold."""
        return [fold.y_hat for fold in self.folds]

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """Diagnostics that raised an exception, each line once, whatever the number of folds."""
        findings = [fold.findings for fold in self.folds if fold.findings is not None]
        return tuple(dict.fromkeys(line for one in findings for line in one.failed))


def same_simulations(first: Sequence[Sequence[Array]], again: Sequence[Sequence[Array]]) -> bool:
    """Whether every simulation came out bitwise the same; one sequence a fold."""
    return all(
        a.tobytes() == b.tobytes()
        for one, other in zip(first, again, strict=True)
        for a, b in zip(one, other, strict=True)
    )


@dataclass(frozen=True)
class RefitModel:
    """A model fitted on all training records."""

    model: bytes
    """The model; never parsed outside a sandbox."""
    estimates: ParameterEstimates | None = None
    """What it says of its parameters; None where it says nothing."""


@dataclass(frozen=True)
class Refit:
    """A candidate fitted on all training records, and on one fold a second time."""

    model: RefitModel | CandidateError
    """The model fitted on all training records, or why there is none."""
    fold: int
    """The number of the fold that was fitted again, from 1."""
    again: FoldResult | Failure
    """The result of that second fit."""


def mean_simulation(each: Sequence[tuple[Array, ...] | CandidateError]) -> tuple[Array, ...]:
    """The mean over models of their simulations, one (H, ny) array a block. Raises the first
    CandidateError among them."""
    simulations: list[tuple[Array, ...]] = []
    for one in each:
        if isinstance(one, CandidateError):
            raise one
        simulations.append(one)
    return tuple(np.mean(np.stack(parts), axis=0) for parts in zip(*simulations, strict=True))


FAR_BELOW = 0.6
"""V over the training error, below which it takes more evidence. Honest candidates lie above
0.9."""


def consistency(value: float, training_errors: Sequence[float]) -> float:
    """V over the mean training error of the folds, both normalised by the same standard
    deviations."""
    train = float(np.mean(training_errors))
    return value / train if train > 0 else float("inf")


def derive_seed(root: int, *parts: object) -> int:
    """31-bit seed from the search seed and what it is for, by sha256."""
    text = ":".join(str(p) for p in (root, *parts))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1


def score_outputs(
    folds: Sequence[Fold],
    outputs: Sequence[Sequence[Array]],
    metric: str,
    *,
    in_parts: bool = False,
) -> Outcome:
    """Score given simulations, one (H, ny) array a held-out block of each fold."""
    scores = [
        score_fold([b.y for b in fold.validation], y_hat, fold.scale, metric, in_parts=in_parts)
        for fold, y_hat in zip(folds, outputs, strict=True)
    ]
    return combine(scores)
