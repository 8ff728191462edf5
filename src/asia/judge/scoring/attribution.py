"""Attribution of a gain to the model, the training, or both together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array
from asia.errors import InternalError
from asia.judge.scoring.repeated_fits import Interval, student_quantile

_ATTRIBUTION_LEVEL = 0.95


@dataclass(frozen=True)
class Attribution:
    """A gain of V in parts that add up to it, each with a 95 % interval over the seeds."""

    gain: Interval
    """V of the baseline less that of the winner."""
    model: Interval
    """Gain from the winner's model with the baseline's training."""
    training: Interval
    """Gain from the winner's training with the baseline's model."""
    interaction: Interval
    """Gain from the combination that neither gives alone."""

    def share(self, part: Interval) -> float | None:
        """Return a part as a share of the gain; None where there is no gain."""
        return part.value / self.gain.value if self.gain.value > 0 else None


def attribute(
    baseline: Array, model_alone: Array, training_alone: Array, winner: Array
) -> Attribution:
    """Attribute a gain by the four crossings of two models and two trainings.

    Args:
        baseline, model_alone, training_alone, winner: V over the seeds, (seeds,); a single
            value where fits do not depend on the seed
    """
    base, model, training, both = _paired(baseline, model_alone, training_alone, winner)
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
