"""Least significant difference of V, given the variance over seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import variance

_LEVEL = 0.9


def student_quantile(level: float, degrees: float) -> float:
    """Half the width of a two-sided interval of Student's t, in standard errors."""
    from scipy.special import stdtrit  # only where statistics are asked for

    return float(stdtrit(degrees, 0.5 + level / 2.0))


def least_significant_difference(one: Sequence[float], other: Sequence[float]) -> float:
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
