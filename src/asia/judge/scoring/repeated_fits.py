"""Statistics of repeated fits: significance of a difference, expected error of a best candidate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, variance
from typing import Final

import numpy as np

from asia.data.trajectory import Array
from asia.errors import InternalError
from asia.judge.scoring.residuals import pooled
from asia.problem.metrics import find_metric

_LEVEL = 0.9


def student_quantile(level: float, degrees: float) -> float:
    """Half the width of a two-sided interval of Student's t, in standard errors."""
    from scipy.special import stdtrit  # only where statistics are asked for

    return float(stdtrit(degrees, 0.5 + level / 2.0))


def significance_threshold(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the least difference of the means of two candidates over their seeds that is
    significant.

    It is half of a two-sided 90 % interval by Student's t with the pooled variance; 0 where the
    fits of neither depend on the seed.

    Args:
        one, other: V of each from several seeds, a single value of one whose fits do not depend
            on the seed
    """
    repeated = [values for values in (one, other) if len(values) > 1]
    degrees = sum(len(values) - 1 for values in repeated)
    if not degrees:
        return 0.0
    pooled = sum((len(values) - 1) * variance(values) for values in repeated) / degrees
    error = math.sqrt(pooled * sum(1.0 / len(values) for values in repeated))
    return student_quantile(_LEVEL, degrees) * error


RANKED = 3
"""Seeds of each candidate from which on ranks alone are significant: by chance all V of one are
below all of the other in one case of 20 (Mann and Whitney, Annals of Mathematical Statistics 18,
1947)."""


def is_lower(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether V of `one` over its seeds is significantly lower than that of `other`: by the
    means, or by the ranks, which a few lost fits of the other do not blur."""
    if fmean(other) - fmean(one) > significance_threshold(one, other):
        return True
    return min(len(one), len(other)) >= RANKED and max(one) < min(other)


# Comparison of a few candidates over several seeds: differences and expected error.
#
# The held-out samples of each fold are cut into blocks. A candidate is compared with another on
# the same blocks and from the same seeds, so that common difficulty cancels. The error to expect
# of a best candidate is estimated by a bootstrap over the blocks that also chooses the best
# candidate anew: it is judged on the blocks that had no part in the choice (Tsamardinos, Greasidou
# and Borboudakis, Machine Learning 107, 2018, "Bootstrapping the out-of-sample predictions").

BLOCKS: Final = 8
_DRAWS = 2000


@dataclass(frozen=True)
class RepeatedFits:
    """The errors of one candidate on the folds, from one or several seeds."""

    values: Array
    """Contributions to V, (seeds, folds)."""
    blocks: Array
    """The share of each block of held-out samples in it, (seeds, folds, blocks): see
    `block_values`."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.blocks.shape[:2] != self.values.shape:
            raise InternalError(f"fits {self.values.shape} with blocks {self.blocks.shape}")

    @property
    def value(self) -> float:
        """V, the mean over seeds and folds."""
        return float(self.values.mean())

    @property
    def by_seed(self) -> Array:
        """V from each seed, (seeds,)."""
        return self.values.mean(axis=1)

    @property
    def spread(self) -> float | None:
        """Standard deviation of V over the seeds; None with one seed."""
        return float(self.by_seed.std(ddof=1)) if len(self.values) > 1 else None


@dataclass(frozen=True)
class Interval:
    """An estimate and the interval around it."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class ExpectedError:
    """The error on new records to expect of a best candidate, in the measure of V."""

    value: float
    low: float
    """The lower end of the interval for one new record as long as a fold."""
    high: float
    optimism: float
    """Optimism: difference between V of a best candidate and its error on samples that had no part
    in the choice."""


def block_values(
    y: Sequence[Array], y_hat: Sequence[Array], scale: Array, metric: str, blocks: int = BLOCKS
) -> Array:
    """Return the jackknife pseudo-values of up to `blocks` equal parts of held-out samples.

    Their mean is the value of the fold up to a bias of second order (delete-a-block jackknife).

    Args:
        y, y_hat: one (H, ny) array a block of the protocol
        scale: (ny,)
    """
    a, b = pooled(y), pooled(y_hat)
    parts = np.array_split(np.arange(len(a)), min(blocks, len(a)))
    judge, n = find_metric(metric), len(parts)
    whole = judge.shortfall(a, b, scale)
    if n < 2:
        return np.array([whole])
    left = [
        judge.shortfall(np.delete(a, part, axis=0), np.delete(b, part, axis=0), scale)
        for part in parts
    ]
    return n * whole - (n - 1) * np.array(left)


def paired_difference(one: RepeatedFits, other: RepeatedFits, level: float) -> Interval:
    """Return the difference of V of two candidates, with an interval by Student's t.

    Two variances are added: that of the paired differences over the blocks, which measures the
    effect of the choice of the held-out samples, and over the seeds. Their degrees of freedom are
    Satterthwaite's. A candidate with one seed is one whose fits do not depend on it.
    """
    gaps = one.blocks.mean(axis=0) - other.blocks.mean(axis=0)
    fewest, count = sorted((len(one.values), len(other.values)))
    if fewest > 1:
        count = fewest
    over_seeds = one.by_seed[:count] - other.by_seed[:count]
    return _around(one.value - other.value, (gaps, over_seeds), level)


def value_interval(fits: RepeatedFits, level: float) -> Interval:
    """V of one candidate, with an interval as that of `paired_difference`."""
    return _around(fits.value, (fits.blocks.mean(axis=0), fits.by_seed), level)


def _around(value: float, means: Sequence[Array], level: float) -> Interval:
    """Interval by Student's t around a sum of means, each given by its values; a single value adds
    no variance."""
    each = [(float(v.var(ddof=1)) / v.size, v.size - 1) for v in means if v.size > 1]
    each = [(variance, degrees) for variance, degrees in each if variance > 0.0]
    if not each:
        return Interval(value, value, value)
    total = sum(variance for variance, _ in each)
    degrees = total**2 / sum(variance**2 / degrees for variance, degrees in each)
    half = student_quantile(level, degrees) * math.sqrt(total)
    return Interval(value, value - half, value + half)


def corrected_level(level: float, comparisons: int) -> float:
    """The level of each of several intervals that hold together with at least `level`, by
    Bonferroni."""
    return 1.0 - (1.0 - level) / max(1, comparisons)


def noise_of_seeds(each: Sequence[RepeatedFits]) -> float | None:
    """The standard deviation of V over seeds, pooled over the candidates; None where none was
    fitted from two seeds."""
    repeated = [fits for fits in each if len(fits.values) > 1]
    degrees = sum(len(fits.values) - 1 for fits in repeated)
    if not degrees:
        return None
    squares = sum((len(f.values) - 1) * float(f.by_seed.var(ddof=1)) for f in repeated)
    return math.sqrt(squares / degrees)


def selection_optimism(tried: Array, seed: int) -> float:
    """Estimate the optimism of V of the lowest of several candidates, never below 0.

    The optimism is the difference from its error on samples that had no part in the choice.

    Args:
        tried: the block values of all candidates, (candidates, folds, blocks)
    """
    candidates, folds, blocks = tried.shape
    if candidates < 2 or blocks < 2:
        return 0.0
    random = np.random.default_rng(seed)
    gaps: list[float] = []
    lowest = float(tried.mean(axis=(1, 2)).min())
    for _ in range(_DRAWS):
        drawn = random.integers(blocks, size=(folds, blocks))
        counts = np.stack([np.bincount(one, minlength=blocks) for one in drawn])
        left_out = counts == 0
        if not left_out.any(axis=1).all():
            continue
        best = tried[int(np.argmin((tried * counts).sum(axis=(1, 2))))]
        error = float(np.mean([w[out].mean() for w, out in zip(best, left_out, strict=True)]))
        gaps.append(error - lowest)
    return max(0.0, float(np.mean(gaps))) if gaps else 0.0


def expected_error(best: RepeatedFits, tried: Array, level: float, seed: int) -> ExpectedError:
    """The error of the best candidate on one new record of the same kind, as long as the held-out
    part of one fold.

    The estimate is V of `best`, the fit that is handed over or the mean of several, and
    the optimism of `tried`. The interval is of Student's t on the logarithmic scale, with the
    variance of a new fold's value, that of the mean over the known ones, and that over the seeds.
    The values of folds vary by their blocks at least, which count as independent, and by more where
    fold models or records are unlike each other."""
    optimism = selection_optimism(tried, seed)
    centre = best.value + optimism
    parts = best.blocks.mean(axis=0)
    folds, blocks = parts.shape
    within = float(parts.var(axis=1, ddof=1).mean()) / blocks if blocks > 1 else 0.0
    between = float(parts.mean(axis=1).var(ddof=1)) if folds > 1 else 0.0
    seeds = 0.0 if best.spread is None else best.spread**2
    total = max(within, between) * (1.0 + 1.0 / folds) + seeds
    if centre <= 0.0 or total == 0.0:
        return ExpectedError(centre, centre, centre, optimism)
    half = student_quantile(level, max(1, parts.size - 1)) * math.sqrt(total) / centre
    return ExpectedError(centre, centre * math.exp(-half), centre * math.exp(half), optimism)


def expected_of_ensemble(
    expected: ExpectedError, fold_errors: Sequence[float], ensemble_error: float
) -> Interval:
    """Estimate the error of the mean of the fold models' simulations on a new record, from that of
    a fold model.

    The mean is better by the disagreement of the fold models (Krogh and Vedelsby, Advances in
    Neural Information Processing Systems 7, 1995), which is assumed equal on new and on training
    records.

    Args:
        fold_errors: error of each fold model on the training records
        ensemble_error: error of their mean there
    """
    mean = float(np.mean(fold_errors))
    share = 1.0 if mean <= 0.0 else min(1.0, ensemble_error / mean)
    return Interval(expected.value * share, expected.low * share, expected.high * share)


def expected_lowest(number: int) -> float:
    """Return the expectation of the lowest of `number` independent standard normal numbers: the
    apparent advantage of the best of several equally good candidates, in standard deviations
    below their mean."""
    x = np.linspace(-12.0, 12.0, 48_001)
    from scipy.special import ndtr  # only where statistics are asked for

    survives = (1.0 - ndtr(x)) ** number
    density = -np.gradient(survives, x)
    return float(np.trapezoid(x * density, x))


_ATTRIBUTION_LEVEL = 0.95


@dataclass(frozen=True)
class Attribution:
    """A gain of V in parts that add up to it, each with a 95 % interval over the seeds."""

    gain: Interval
    """V of the baseline less that of the best candidate."""
    model: Interval
    """Gain from the best candidate's model with the baseline's training."""
    training: Interval
    """Gain from the best candidate's training with the baseline's model."""
    interaction: Interval
    """Gain from the combination that neither gives alone."""

    def share(self, part: Interval) -> float | None:
        """Return a part as a share of the gain; None where there is no gain."""
        return part.value / self.gain.value if self.gain.value > 0 else None


def attribute(
    baseline: Array, model_alone: Array, training_alone: Array, best: Array
) -> Attribution:
    """Attribute a gain by the four crossings of two models and two trainings.

    Args:
        baseline, model_alone, training_alone, best: V over the seeds, (seeds,); a single
            value where fits do not depend on the seed
    """
    base, model, training, both = _paired(baseline, model_alone, training_alone, best)
    return Attribution(
        _gain_over_seeds(base - both),
        _gain_over_seeds(base - model),
        _gain_over_seeds(base - training),
        _gain_over_seeds(model + training - base - both),
    )


def gain(before: Array, after: Array) -> Interval:
    """V before less V after, over the same seeds, (seeds,) each."""
    one, other = _paired(before, after)
    return _gain_over_seeds(one - other)


def _gain_over_seeds(values: Array) -> Interval:
    mean, half = float(values.mean()), 0.0
    if len(values) > 1:
        error = float(values.std(ddof=1)) / len(values) ** 0.5
        half = student_quantile(_ATTRIBUTION_LEVEL, len(values) - 1) * error
    return Interval(mean, mean - half, mean + half)


def _paired(*each: Array) -> tuple[Array, ...]:
    counts = [len(values) for values in each if len(values) != 1]
    if not all(len(values) for values in each):
        raise InternalError("a crossing without a score was about to be attributed")
    count = min(counts, default=1)
    return tuple(
        np.repeat(values, count) if len(values) == 1 else values[:count] for values in each
    )
