"""What an experiment comes to: a Score, finite by construction, or a Failure with a reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.errors import CandidateError, InternalError, Reason
from asia.scoring._metrics import METRICS, fit_index, mae, pooled, r2, rmse

DIVERGED = 1e100
PARTS = 8


@dataclass(frozen=True)
class FoldScore:
    """One fold: `value` is the normalised metric that enters V; errors per channel are in
    physical units, fit index in percent; None where the held-out output does not move. `parts` is
    the normalised metric on PARTS equal parts of the held-out samples in turn, () where nothing
    asks for it. Raises InternalError when a number is not finite."""

    value: float
    rmse: tuple[float, ...]
    mae: tuple[float, ...]
    fit_index: tuple[float | None, ...]
    r2: tuple[float | None, ...]
    parts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.value, *self.rmse, *self.mae, *self.fit_index, *self.r2, *self.parts)
        if not all(n is None or math.isfinite(n) for n in numbers):
            raise InternalError("a score that is not finite was about to be recorded")

    @property
    def worst_fit(self) -> float | None:
        """The lowest fit index over the channels."""
        return min((f for f in self.fit_index if f is not None), default=None)


@dataclass(frozen=True)
class Score:
    """V = mean over folds. Raises InternalError when anything in it is not finite."""

    value: float
    folds: tuple[FoldScore, ...]

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise InternalError("a score that is not finite was about to be recorded")


@dataclass(frozen=True)
class Failure:
    """Why there is no score; `fold` is 1-based, None when no fold was reached."""

    reason: Reason
    detail: str = ""
    fold: int | None = None

    @property
    def advice(self) -> str:
        """What happened and what to do."""
        return self.reason.advice


Outcome = Score | Failure


@dataclass(frozen=True)
class TestScore:
    """Error on the sealed test in physical units: mean over channels of the pooled error, the
    pooled error of each channel, and the mean over channels for each trajectory."""

    metric: str
    value: float
    per_channel: tuple[float, ...]
    per_trajectory: tuple[float, ...]


def check_reply(y_hat: Array, shape: tuple[int, ...]) -> None:
    """Raises CandidateError unless `y_hat` has the shape and has not run away beyond 1e100."""
    if y_hat.shape != shape:
        raise CandidateError(Reason.WRONG_LENGTH, f"expected {shape}, got {y_hat.shape}")
    if not bool((np.abs(y_hat) < DIVERGED).all()):
        raise CandidateError(Reason.NOT_FINITE)


def score_fold(
    y: Sequence[Array], y_hat: Sequence[Array], scale: Array, metric: str, *, in_parts: bool = False
) -> FoldScore:
    """Score the simulated blocks of one fold.

    y, y_hat: one (H, ny) array a block; scale (ny,). The metric of each channel is taken over all
    samples of all blocks, divided by scale, and averaged over the channels. in_parts: fill
    `FoldScore.parts`.
    Raises CandidateError for a reply of the wrong size or not finite.
    """
    for measured, simulated in zip(y, y_hat, strict=True):
        check_reply(simulated, measured.shape)
    a, b = pooled(y), pooled(y_hat)
    value = float(np.mean(METRICS[metric](a, b) / scale))
    if not math.isfinite(value):
        raise CandidateError(Reason.NOT_FINITE)
    parts: tuple[float, ...] = ()
    if in_parts:
        cut = zip(np.array_split(a, PARTS), np.array_split(b, PARTS), strict=True)
        parts = tuple(float(np.mean(METRICS[metric](c, d) / scale)) for c, d in cut if len(c))
    indices = _defined(fit_index(a, b)), _defined(r2(a, b))
    return FoldScore(value, _t(rmse(a, b)), _t(mae(a, b)), *indices, parts)


def combine(folds: Sequence[FoldScore]) -> Score:
    """V over the folds."""
    return Score(float(np.mean([f.value for f in folds])), tuple(folds))


def score_test(y: Sequence[Array], y_hat: Sequence[Array], metric: str, skip: int = 0) -> TestScore:
    """Error on the test set in physical units, the first `skip` samples of each block left out."""
    for measured, simulated in zip(y, y_hat, strict=True):
        check_reply(simulated, measured.shape)
    measure = METRICS[metric]
    kept = [(a[skip:], b[skip:]) for a, b in zip(y, y_hat, strict=True)]
    channels = measure(pooled([a for a, _ in kept]), pooled([b for _, b in kept]))
    each = tuple(float(np.mean(measure(a, b))) for a, b in kept)
    return TestScore(metric, float(np.mean(channels)), _t(channels), each)


def _defined(values: Array) -> tuple[float | None, ...]:
    return tuple(float(v) if math.isfinite(v) else None for v in values)


def _t(values: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
