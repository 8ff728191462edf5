"""Results of an evaluation."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field, TypeAdapter

from asia.candidate import ParameterEstimates
from asia.data.trajectory import Array
from asia.errors import CandidateError
from asia.judge.evaluation.artifacts import ArtifactName, ArtifactStore
from asia.judge.evaluation.training_checks import TrainingCheck
from asia.judge.scoring.outcome import Outcome, combine, score_fold
from asia.judge.scoring.residuals import Diagnostics, SignedResidual
from asia.problem.folds import Fold


@dataclass(frozen=True)
class StepErrors:
    """The errors on the held-out windows at one step."""

    step: int
    """Step within the window, from 1."""
    errors: tuple[float, ...]
    """Metric of each output, as it enters V."""


@dataclass(frozen=True)
class FoldFindings:
    """Diagnostics of the model of one fold."""

    errors: tuple[float, ...]
    """The metric of each output on the held-out part, as it enters V."""
    train_errors: tuple[float, ...]
    """The same on the training records."""
    steps: tuple[StepErrors, ...] = ()
    """The held-out errors at the steps that the protocol names; () for long simulations."""
    residuals: tuple[SignedResidual, ...] = ()
    """Mean residuals in the simulation of the training records, the largest shares first."""
    parameters: tuple[tuple[str, float], ...] = ()
    """Names and values that the model offers."""
    compile_seconds: float = 0.0
    """Time in which JAX traced and compiled in the fit, as the worker reported before its first
    case."""
    memory_mb: float | None = None
    """The largest address space of the worker before its first case; None where the system does not
    say."""
    printed: str = ""
    """Text that the candidate printed during the fit, its middle left out where it is long."""
    held_out_residuals: tuple[SignedResidual, ...] = ()
    """Mean residuals in the simulation of the held-out part; () unless the protocol shows these."""
    checks: tuple[TrainingCheck, ...] | None = None
    """Those of `asia validate` that do not pass on the training records; None in older ledgers and
    where these checks failed."""
    failed: Annotated[tuple[str, ...], Field(exclude_if=lambda value: not value)] = ()
    """Diagnostics that raised an exception, a line each."""
    numbers: int | None = None
    """Count of the numbers in the fitted model, as the worker reported before its first case; None
    if not known, and in older ledgers."""
    sample_seconds: float | None = None
    """Processor time to simulate a sample of the training records, compiled before; None in older
    ledgers."""


_FINDINGS: TypeAdapter[FoldFindings] = TypeAdapter(FoldFindings)


def put_findings(store: ArtifactStore, findings: FoldFindings) -> ArtifactName:
    """Keep findings and return the name of the artifact."""
    return store.put(_FINDINGS.dump_json(findings))


def get_findings(store: ArtifactStore, name: ArtifactName) -> FoldFindings:
    """Return the findings in an artifact. Raises UserError as `ArtifactStore.parse`."""
    return store.parse(name, _FINDINGS)


@dataclass(frozen=True)
class FoldRecord:
    """One fold of a candidate, in an evaluation and in a ledger. Its score is in the outcome."""

    model: ArtifactName
    """The fitted model; never parsed outside a sandbox."""
    y_hat: ArtifactName
    """Simulated outputs (H, ny) of each held-out block."""
    curve: ArtifactName
    """Step and loss as logged by the candidate, (n, 2)."""
    diagnostics: Diagnostics
    fit_seconds: float
    validation_scores: int = 0
    """Number of requests of the fit for its score on the held-out part."""
    findings: ArtifactName | None = None
    """`FoldFindings`; None in older ledgers."""
    machine: Annotated[str, Field(exclude_if=lambda value: not value)] = ""
    """The machine that fitted it; "" for the search's own."""
    isolation: Annotated[str, Field(exclude_if=lambda value: not value)] = ""
    """The level in force on that machine; "" for the search's own."""
    attempt: Annotated[int, Field(exclude_if=lambda value: not value)] = 0
    """Seed of the fit in older ledgers, where the first one fitted the fold's own data badly."""


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one candidate on all folds, or on one of them."""

    outcome: Outcome
    folds: tuple[FoldRecord, ...] = ()
    """The records of all folds; empty if one of them failed."""
    output: str = ""
    """Text that the candidate printed during the first fold's fit, or that of a fold that failed,
    capped and stripped."""
    validation_scores: int = 0
    """Number of scores on held-out parts that the candidate requested, in all folds, failed ones
    included."""
    artifacts: ArtifactStore = field(default_factory=ArtifactStore, repr=False, compare=False)
    """The large parts of `folds`."""

    @property
    def findings(self) -> list[FoldFindings]:
        """Findings of the folds that have some."""
        names = [fold.findings for fold in self.folds]
        return [get_findings(self.artifacts, name) for name in names if name is not None]

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """Diagnostics that raised an exception, each line once, whatever the number of folds."""
        return tuple(dict.fromkeys(line for one in self.findings for line in one.failed))


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
