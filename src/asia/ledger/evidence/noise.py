"""Variance of V over seeds."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from statistics import fmean, variance

from asia.ledger._exports import error_value
from asia.ledger._view import Experiment, SearchView
from asia.scoring import least_significant_difference


def noise_of_repeats(view: SearchView, among: Collection[int] = ()) -> float | None:
    """Return the standard deviation of V over fits of the same source, pooled over all sources that
    were fitted repeatedly.

    Args:
        view: the search.
        among: experiments of interest. If one of these was repeated, the others do not count,
            because a family far above them in V has another variance.

    Returns:
        The standard deviation; None if no source was repeated.
    """
    own = _pooled([e for e in view.finished if e.number in among])
    return _pooled(view.finished) if own is None else own


def _pooled(experiments: Sequence[Experiment]) -> float | None:
    values: defaultdict[str, list[float]] = defaultdict(list)
    for experiment in experiments:
        result, score = experiment.result, experiment.score
        if score is not None and result is not None and result.duplicate_of is None:
            values[experiment.proposed.digest] += experiment.seed_values
    repeated = [one for one in values.values() if len(one) > 1]
    if not repeated:
        return None
    degrees = sum(len(one) - 1 for one in repeated)
    return math.sqrt(sum((len(one) - 1) * variance(one) for one in repeated) / degrees)


def floor_to_beat(view: SearchView) -> float | None:
    """Return the significance threshold: the improvement of the mean over seeds that a candidate
    with the same variance needs to be kept.

    Returns:
        The improvement; 0 if the incumbent does not depend on the seed, None if that is not known
            or one fit decides.
    """
    held = view.incumbent
    if held is None or held.result is None or not held.result.retests:
        return None
    return least_significant_difference(held.seed_values, held.seed_values)


def method_words(view: SearchView) -> str:
    """Why the experiment that is handed over is not the incumbent; "" where it is."""
    best, held = view.best, view.incumbent
    if best is None or held is None or best.number == held.number:
        return ""
    return (
        f"#{best.number:02d} and #{held.number:02d} are statistically equal; #{best.number:02d} is "
        "handed over, because its own fit has the lowest V"
    )


def floor_words(view: SearchView) -> str:
    """`0.0031 below 0.1312, the mean of #07 over 3 seeds`; "" where it is not known."""
    held, floor = view.incumbent, floor_to_beat(view)
    if held is None or floor is None:
        return ""
    values = held.seed_values
    if len(values) == 1:
        return f"0: #{held.number:02d} does not depend on the seed"
    mean = error_value(fmean(values))
    return f"{floor:.2g} below {mean}, the mean of #{held.number:02d} over {len(values)} seeds"
