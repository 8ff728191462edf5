"""Outcomes: scores, failures, and their computation from simulated outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter

from asia.data.trajectory import Array
from asia.errors import CandidateError, InternalError, Reason, UserError
from asia.judge.artifacts import ArtifactName, ArtifactStore
from asia.judge.scoring.checks.check import RecordedCheck
from asia.judge.scoring.residuals import Diagnostics, SignedResidual, pooled
from asia.problem.folds import Fold
from asia.problem.metrics import METRICS, by_measured, find_metric, mean_of_known

# Measures of fit in addition to the metric. Arrays are (samples, channels) in physical units.


def fit_index(y: Array, y_hat: Array) -> Array:
    """100 (1 - |y - y_hat| / |y - mean y|) per channel, in percent (Ljung 1999); NaN
    where y is constant."""
    return 100.0 * (1.0 - np.sqrt(by_measured(_energy_ratio, y, y_hat)))


def r2(y: Array, y_hat: Array) -> Array:
    """Coefficient of determination of each channel; NaN where y is constant."""
    return 1.0 - by_measured(_energy_ratio, y, y_hat)


def _energy_ratio(y: Array, y_hat: Array) -> Array:
    """NaN where an output does not move: it has no fit index."""
    spread = np.sum((y - y.mean(axis=0)) ** 2, axis=0)
    with np.errstate(over="ignore"):
        return np.sum((y - y_hat) ** 2, axis=0) / np.where(spread > 0, spread, np.nan)


# Outcome of an experiment: a Score, finite by construction, or a Failure with a reason.

DIVERGED = 1e100
PARTS = 8


@dataclass(frozen=True)
class StepErrors:
    """The errors on the held-out windows at one step."""

    step: int
    """Step within the window, from 1."""
    errors: tuple[float, ...]
    """Metric of each output, as it enters V."""


# Fields that are left out of JSON where they hold nothing.
_EMPTY: Any = Field(exclude_if=lambda value: not value)
_UNKNOWN: Any = Field(exclude_if=lambda value: value is None)
_NO_DIAGNOSTICS = Diagnostics()
_ABSENT: Any = Field(exclude_if=lambda value: value == _NO_DIAGNOSTICS)


@dataclass(frozen=True, repr=False)
class FoldRecord:
    """One fold of a model: its score, and of a fitted candidate the fit and its diagnostics.

    A ledger holds it as `stored`; what is empty then comes back by `loaded`. Two records are equal
    where their scores are. Raises InternalError when a number of the score is not finite.
    """

    value: float
    """The metric as it enters V: mean over the outputs, lower is better."""
    rmse: tuple[float, ...]
    """RMSE of each output in its unit."""
    mae: tuple[float, ...]
    """MAE of each output in its unit."""
    fit_index: tuple[float | None, ...]
    """Fit index of each output in percent; None where the held-out output does not move."""
    r2: tuple[float | None, ...]
    """R^2 of each output; None where the held-out output does not move."""
    other: Annotated[tuple[float, ...], _EMPTY] = ()
    """The problem's metric of each output where it is neither RMSE nor MAE, else ()."""
    model: Annotated[ArtifactName, _EMPTY] = field(default="", compare=False)
    """The fitted model, never parsed outside a sandbox; "" where nothing was fitted."""
    y_hat: Annotated[ArtifactName, _EMPTY] = field(default="", compare=False)
    """Simulated outputs (H, ny) of each held-out block."""
    curve: Annotated[ArtifactName, _EMPTY] = field(default="", compare=False)
    """Step and loss as logged by the candidate, (n, 2)."""
    diagnostics: Annotated[Diagnostics, _ABSENT] = field(default=_NO_DIAGNOSTICS, compare=False)
    fit_seconds: Annotated[float, _EMPTY] = field(default=0.0, compare=False)
    validation_scores: Annotated[int, _EMPTY] = field(default=0, compare=False)
    """Number of requests of the fit for its score on the held-out part."""
    findings: Annotated[ArtifactName | None, _UNKNOWN] = field(default=None, compare=False)
    """The whole record; None before it is stored, and in older ledgers."""
    machine: Annotated[str, _EMPTY] = field(default="", compare=False)
    """The machine that fitted it; "" for the search's own."""
    isolation: Annotated[str, _EMPTY] = field(default="", compare=False)
    """The level in force on that machine; "" for the search's own."""
    attempt: Annotated[int, _EMPTY] = field(default=0, compare=False)
    """Seed of the fit in older ledgers, where the first one fitted the fold's own data badly."""
    errors: Annotated[tuple[float, ...], _EMPTY] = field(default=(), compare=False)
    """The metric of each output on the held-out part, as it enters V."""
    train_errors: Annotated[tuple[float, ...], _EMPTY] = field(default=(), compare=False)
    """The same on the training records."""
    steps: Annotated[tuple[StepErrors, ...], _EMPTY] = field(default=(), compare=False)
    """The held-out errors at the steps that the protocol names; () for long simulations."""
    residuals: Annotated[tuple[SignedResidual, ...], _EMPTY] = field(default=(), compare=False)
    """Mean residuals in the simulation of the training records, the largest shares first."""
    held_out_residuals: Annotated[tuple[SignedResidual, ...], _EMPTY] = field(
        default=(), compare=False
    )
    """Mean residuals in the simulation of the held-out part; () unless the protocol shows these."""
    parameters: Annotated[tuple[tuple[str, float], ...], _EMPTY] = field(default=(), compare=False)
    """Names and values that the model offers."""
    checks: Annotated[tuple[RecordedCheck, ...] | None, _UNKNOWN] = field(
        default=None, compare=False
    )
    """Those of `asia validate` that do not pass on the training records; None in older ledgers and
    where these checks failed."""
    failed: Annotated[tuple[str, ...], _EMPTY] = field(default=(), compare=False)
    """Diagnostics that raised an exception, a line each."""
    printed: Annotated[str, _EMPTY] = field(default="", compare=False)
    """Text that the candidate printed during the fit, its middle left out where it is long."""
    compile_seconds: Annotated[float, _EMPTY] = field(default=0.0, compare=False)
    """Time in which JAX traced and compiled in the fit, as the worker reported before its first
    case."""
    memory_mb: Annotated[float | None, _UNKNOWN] = field(default=None, compare=False)
    """The largest address space of the worker before its first case; None where the system does not
    say."""
    numbers: Annotated[int | None, _UNKNOWN] = field(default=None, compare=False)
    """Count of the numbers in the fitted model, as the worker reported before its first case; None
    if not known, and in older ledgers."""
    sample_seconds: Annotated[float | None, _UNKNOWN] = field(default=None, compare=False)
    """Processor time to simulate a sample of the training records, compiled before; None in older
    ledgers."""

    def __post_init__(self) -> None:
        lists = self.rmse, self.mae, self.fit_index, self.r2, self.other
        numbers = (self.value, *chain.from_iterable(lists))
        if not all(n is None or math.isfinite(n) for n in numbers):
            raise InternalError("a score that is not finite was about to be recorded")

    def __repr__(self) -> str:
        return (
            f"<V {self.value:.6f}, training {self.diagnostics.train_error:.6f}, "
            f"fit {self.fit_seconds:.1f} s>"
        )

    def per_channel(self, metric: str) -> tuple[float, ...]:
        """The problem's metric of each output, in the metric's unit."""
        return {"rmse": self.rmse, "mae": self.mae}.get(metric, self.other)

    @property
    def worst_fit(self) -> float | None:
        """The lowest fit index over the channels."""
        return min((f for f in self.fit_index if f is not None), default=None)

    @property
    def score(self) -> FoldRecord:
        """The score alone, as of a model that was not fitted."""
        return FoldRecord(self.value, self.rmse, self.mae, self.fit_index, self.r2, self.other)

    def stored(self, store: ArtifactStore) -> FoldRecord:
        """Keep the record as an artifact, and return the part of it that an event holds."""
        whole = self.findings or store.put(_RECORD.dump_json(self))
        return replace(
            self, findings=whole, errors=(), train_errors=(), steps=(), residuals=(),
            held_out_residuals=(), parameters=(), checks=None, failed=(), printed="",
            compile_seconds=0.0, memory_mb=None, numbers=None, sample_seconds=None,
        )  # fmt: skip

    def loaded(self, store: ArtifactStore) -> FoldRecord:
        """Return the whole record; itself in older ledgers. Raises UserError as
        `ArtifactStore.parse`."""
        if self.findings is None:
            return self
        return store.parse(self.findings, _RECORD, _RECORD.dump_python(self, mode="json"))


_RECORD: TypeAdapter[FoldRecord] = TypeAdapter(FoldRecord)


@dataclass(frozen=True)
class Score:
    """Score of a candidate. Raises InternalError when it is not finite."""

    value: float
    """V, the mean over the folds."""
    folds: tuple[FoldRecord, ...]
    """One a fold, in order."""

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise InternalError("a score that is not finite was about to be recorded")


@dataclass(frozen=True)
class Failure:
    """Reason for a missing score."""

    reason: Reason
    detail: str = ""
    """Exception text or measurement, of any length."""
    fold: int | None = None
    """The fold that failed, 1-based; None when no fold was reached."""
    folds: Annotated[tuple[FoldRecord, ...], _EMPTY] = field(default=(), compare=False)
    """The folds where all were scored, and the candidate was refused after that."""

    @property
    def advice(self) -> str:
        """Description of the failure and its remedy."""
        return self.reason.advice


Outcome = Score | Failure


@dataclass(frozen=True)
class TestScore:
    """One metric on the sealed test, in the metric's own unit."""

    metric: str
    value: float
    per_channel: tuple[float, ...]
    """Score of each output, over the samples of all trajectories."""
    per_trajectory: tuple[float, ...]
    """Score of each trajectory, the mean over the outputs."""


def check_reply(y_hat: Array, shape: tuple[int, ...]) -> None:
    """Raise CandidateError unless `y_hat` has the shape and is below 1e100 everywhere."""
    if y_hat.shape != shape:
        raise CandidateError(Reason.WRONG_LENGTH, f"expected {shape}, got {y_hat.shape}")
    if not bool((np.abs(y_hat) < DIVERGED).all()):
        raise CandidateError(Reason.NOT_FINITE)


def score_fold(y: Sequence[Array], y_hat: Sequence[Array], scale: Array, metric: str) -> FoldRecord:
    """Score the simulated blocks of one fold.

    The metric of each channel is taken over all measured samples of all blocks, divided by scale
    where the metric is in the unit of the output, and averaged over the channels.

    Args:
        y, y_hat: one (H, ny) array a block
        scale: (ny,)

    Raises:
        CandidateError: for a reply of the wrong size or not finite
        UserError: when the metric cannot be computed
    """
    for measured, simulated in zip(y, y_hat, strict=True):
        check_reply(simulated, measured.shape)
    a, b = pooled(y), pooled(y_hat)
    judge = find_metric(metric)
    value = judge.shortfall(a, b, scale)
    if not math.isfinite(value):
        raise CandidateError(Reason.NOT_FINITE)
    indices = _defined(fit_index(a, b)), _defined(r2(a, b))
    rmse, mae = (_t(METRICS[name].values(a, b)) for name in ("rmse", "mae"))
    other = () if metric in ("rmse", "mae") else _t(judge.values(a, b))
    return FoldRecord(value, rmse, mae, *indices, other)


def score_parts(
    y: Sequence[Array], y_hat: Sequence[Array], scale: Array, metric: str
) -> tuple[float, ...]:
    """Score `PARTS` equal parts of the samples of one fold, without those in which nothing was
    measured; arguments and errors as for `score_fold`, whose value it takes of each part."""
    score_fold(y, y_hat, scale, metric)
    judge = find_metric(metric)
    cut = zip(np.array_split(pooled(y), PARTS), np.array_split(pooled(y_hat), PARTS), strict=True)
    found = (judge.shortfall(a, b, scale) for a, b in cut if len(a))
    return tuple(one for one in found if not math.isnan(one))


def combine(folds: Sequence[FoldRecord]) -> Score:
    """V over the folds."""
    return Score(float(np.mean([f.value for f in folds])), tuple(folds))


def score_outputs(
    folds: Sequence[Fold], outputs: Sequence[Sequence[Array]], metric: str
) -> Outcome:
    """Score given simulations, one (H, ny) array a held-out block of each fold."""
    scores = [
        score_fold([b.y for b in fold.held_out], y_hat, fold.scale, metric)
        for fold, y_hat in zip(folds, outputs, strict=True)
    ]
    return combine(scores)


def same_simulations(first: Sequence[FoldRecord], again: Sequence[FoldRecord]) -> bool:
    """Return whether every simulation came out bitwise the same."""
    return all(one.y_hat == other.y_hat for one, other in zip(first, again, strict=True))


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


POOR = 2.0
"""Training error of a fold, relative to the median of the other folds, from which on its fit
probably ended in a poor minimum."""


USABLE_SHARE = 0.5
"""Least share of the variance of an output that a usable model explains."""


def explained_variance(score: Score, stack: Sequence[float] = ()) -> Array:
    """Return the share (K, ny) of the variance of each output in each fold, about its own mean
    there, that a model explains. NaN where the fold cannot tell: its output moves less than the
    model errs in the other folds.

    Args:
        score: score of the model, or of the best member of a stack.
        stack: value of each fold for a stack; () for a single model.
    """
    folds = score.folds
    share = np.array([[np.nan if r is None else r for r in fold.r2] for fold in folds])
    error = np.array([fold.rmse for fold in folds]) ** 2
    if stack:
        own = np.array([fold.value for fold in folds])
        ratio = (np.array(stack) / np.where(own > 0.0, own, 1.0)) ** 2
        share, error = 1.0 - (1.0 - share) * ratio[:, None], error * ratio[:, None]
    variance = error / np.where(share < 1.0, 1.0 - share, np.nan)
    others = (error.sum(axis=0) - error) / max(len(folds) - 1, 1)
    silent = (variance < others) & (share < USABLE_SHARE)
    # A model that is worse than the mean in all folds together is judged in each.
    total = np.nansum(error, axis=0) >= np.nansum(variance, axis=0)
    return np.where(silent & ~total, np.nan, share)


def folds_below(share: Array, level: float) -> list[int]:
    """Return the numbers of the folds (1-based) whose mean share over the outputs is at most the
    level. share: (K, ny)."""
    return [
        k + 1
        for k, row in enumerate(share)
        if not np.isnan(row).all() and float(np.nanmean(row)) <= level
    ]


def score_test(y: Sequence[Array], y_hat: Sequence[Array], metric: str, skip: int = 0) -> TestScore:
    """The metric on the test set, the first `skip` samples of each block left out. Raises as
    `score_fold`."""
    for measured, simulated in zip(y, y_hat, strict=True):
        check_reply(simulated, measured.shape)
    measure = find_metric(metric).values
    kept = [(a[skip:], b[skip:]) for a, b in zip(y, y_hat, strict=True)]
    channels = measure(pooled([a for a, _ in kept]), pooled([b for _, b in kept]))
    each = tuple(mean_of_known(measure(a, b)) for a, b in kept)
    if np.isnan(pooled([a for a, _ in kept])).all(axis=0).any() or any(
        np.isnan(a).all() for a, _ in kept
    ):
        raise UserError("an output or a record of the test was never measured where it is scored")
    if not np.isfinite([*channels, *each]).all():
        raise CandidateError(Reason.NOT_FINITE, f"the test's {metric} is not finite")
    return TestScore(metric, float(np.mean(channels)), _t(channels), each)


def _defined(values: Array) -> tuple[float | None, ...]:
    return tuple(float(v) if math.isfinite(v) else None for v in values)


def _t(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
