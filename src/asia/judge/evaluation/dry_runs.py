"""A trial of a candidate that costs no experiment: on made-up records like those that the first
fold trains on, and on nothing else. It gives no score."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from asia._text import rounded
from asia._timer import Activity
from asia.data.trajectory import Array, Trajectory, spread_of
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.requests import spread
from asia.judge.scoring.outcome import Failure
from asia.problem.folds import Fold, whole
from asia.problem.protocol import ProtocolRule

_LONGEST_SECONDS = 120.0
_SHARE = 0.25
_FEWEST_SAMPLES = 300
_MOST_SAMPLES = 2000
_MOST_RECORDS = 3
_MOST_WINDOWS = 64
_HELD, _POLE = 10, 0.9


@dataclass(frozen=True)
class DryRun:
    """Result of a dry run."""

    failure: Failure | None
    """Reason for a missing score; None where nothing was found."""
    output: str
    """Text that the candidate printed during its fit, unmodified."""
    samples: int
    of_samples: int
    """Samples that the whole fold trains on."""
    fit_seconds: float | None
    """Duration of the fit; None where it failed."""
    compile_seconds: float
    """Share of the duration in which JAX traced and compiled, in seconds."""
    simulate_seconds: float
    """Duration of the simulations without compilation."""
    limit_seconds: float
    """The limit of a fit in a try."""
    allowed_seconds: float

    def whole_fit_seconds(self) -> float | None:
        """The fit of the whole fold, if its time but for compilation grows as the samples do."""
        if self.fit_seconds is None:
            return None
        compiling = min(self.compile_seconds, self.fit_seconds)
        return compiling + (self.fit_seconds - compiling) * self.of_samples / self.samples


def made_up_fold(fold: Fold, rule: ProtocolRule) -> Fold:
    """Make records up that are like the first training records of `fold`: a quarter of its samples
    or a few hundred, with the same shapes, gaps and rough ranges. They train and are simulated.

    No measured value is in them, because what a candidate prints of them is shown: any record that
    trains one fold is held out by another.
    """
    full = sum(map(len, fold.train))
    wanted = max(_FEWEST_SAMPLES, min(int(_SHARE * full), _MOST_SAMPLES))
    chosen = fold.train[:_MOST_RECORDS]
    # A record must hold a past window and some cases.
    size = max(-(-wanted // len(chosen)), rule.past + max(4 * (rule.horizon or 1), 50))
    random = np.random.default_rng(0)
    inputs = _Ranges(np.concatenate([record.u for record in fold.train]))
    outputs = _Ranges(np.concatenate([record.y for record in fold.train]))
    gains = random.normal(size=(inputs.mean.size, outputs.mean.size))
    records = [
        _made_up(record[: min(size, len(record))], inputs, outputs, gains, random)
        for record in chosen
    ]
    blocks = spread(whole(records, rule), _MOST_WINDOWS)
    scale = spread_of(np.concatenate([block.y for block in blocks]))
    scale = np.where(scale > 0, scale, 1.0)
    return Fold(0, tuple(records), blocks, scale, (False,) * len(blocks))


class _Ranges:
    """Rough ranges of signals (T, n): mean, least and greatest value to a tenth of their spread,
    which has one significant digit. They carry 5 bits each."""

    def __init__(self, values: Array) -> None:
        spread = np.array([rounded(float(one), 1) for one in values.std(axis=0)])
        step = np.where(spread > 0, spread / 10, 1.0)
        self.spread = spread
        self.mean, self.low, self.high = (
            np.where(spread > 0, np.round(one / step) * step, values[0])
            for one in (values.mean(axis=0), values.min(axis=0), values.max(axis=0))
        )

    def fitted(self, values: Array) -> Array:
        """Signals of mean 0 and variance 1 brought to these ranges."""
        return np.clip(self.mean + self.spread * values, self.low, self.high)


def _made_up(
    like: Trajectory,
    inputs: _Ranges,
    outputs: _Ranges,
    gains: Array,
    random: np.random.Generator,
) -> Trajectory:
    """A record in which first-order lags answer steps of the inputs, with some noise."""
    samples = len(like)
    levels = np.repeat(random.normal(size=(-(-samples // _HELD), gains.shape[0])), _HELD, axis=0)
    u = levels[:samples] + 0.1 * random.normal(size=(samples, gains.shape[0]))
    y = np.zeros((samples, gains.shape[1]))
    for k in range(1, samples):
        y[k] = _POLE * y[k - 1] + u[k - 1] @ gains
    y = (y - y.mean(axis=0)) / np.maximum(y.std(axis=0), 1e-12)
    y += 0.05 * random.normal(size=y.shape)
    u, y = inputs.fitted(u), outputs.fitted(y)
    reference = None if like.reference is None else random.normal(size=like.reference.shape)
    return Trajectory(u, y, like.sampling_time, like.name, like.missing, reference)


def allowed_seconds(limit_seconds: float) -> float:
    """The limit of the fit in a dry run, where a try has `limit_seconds`."""
    return min(limit_seconds, _LONGEST_SECONDS)


def dry_run(evaluator: Evaluator, whole_fold: Fold, source: str, limit_seconds: float) -> DryRun:
    """Fit `source` on a short fold, simulate, and reload its model, which must simulate the same.

    Args:
        evaluator: of `made_up_fold` of the whole fold alone, with `allowed_seconds` for a fit and
            without the relations that only a search checks, so that no candidate can rehearse them
        limit_seconds: time limit of a fit in a search
    """
    (short,), stopwatch = evaluator.data.folds, evaluator.workers.stopwatch
    stopwatch.take()
    evaluation = evaluator.evaluate(source)
    spent = {one.activity: one.wall for one in stopwatch.take()}
    failure = None
    if isinstance(evaluation.outcome, Failure):
        failure = replace(evaluation.outcome, fold=None)
    else:
        first = evaluation.folds[0]
        try:
            model = evaluation.artifacts.get(first.model)
            (again,) = evaluator.models.simulate(source, [model], short.held_out)
            if evaluation.artifacts.put_arrays(again) != first.y_hat:
                failure = Failure(Reason.NOT_REPRODUCIBLE)
        except CandidateError as error:
            failure = Failure(Reason.NOT_REPRODUCIBLE, error.detail or error.reason.advice)
    return DryRun(
        failure=failure,
        output=evaluation.output,
        samples=sum(map(len, short.train)),
        of_samples=sum(map(len, whole_fold.train)),
        fit_seconds=evaluation.folds[0].fit_seconds if evaluation.folds else None,
        compile_seconds=sum(spent.get(a, 0.0) for a in (Activity.TRACE, Activity.COMPILE)),
        simulate_seconds=spent.get(Activity.SIMULATE, 0.0),
        limit_seconds=limit_seconds,
        allowed_seconds=allowed_seconds(limit_seconds),
    )
