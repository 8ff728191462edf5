"""How far V moves when nothing changed but luck: the one place where it is asked."""

from __future__ import annotations

import math
from collections import defaultdict
from statistics import variance

from asia.ledger._view import SearchView


def noise_of_repeats(view: SearchView) -> float | None:
    """The standard deviation of V over fits of one and the same source, pooled over the sources
    that were judged more than once; None where no source was."""
    values: defaultdict[str, list[float]] = defaultdict(list)
    for experiment in view.finished:
        result, score = experiment.result, experiment.score
        if score is not None and result is not None and result.duplicate_of is None:
            values[experiment.proposed.digest].append(score.value)
    repeated = [one for one in values.values() if len(one) > 1]
    if not repeated:
        return None
    degrees = sum(len(one) - 1 for one in repeated)
    return math.sqrt(sum((len(one) - 1) * variance(one) for one in repeated) / degrees)
