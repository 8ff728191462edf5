"""Whether V stays where it is when no two folds of a candidate are fitted at the same time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from asia.errors import Reason
from asia.evaluation._relations import SuspicionKind
from asia.evaluation._results import FoldResult, consistency
from asia.scoring import Failure

# V over the training error, below which it takes more evidence; honest candidates lie above 0.9.
FAR_BELOW = 0.6
_UNLIKE = 1.5


def objection_alone(
    folds: Sequence[FoldResult],
    fit_alone: Callable[[int], FoldResult | Failure],
    random: np.random.Generator,
) -> Failure | None:
    """Where V is far below the training error, the folds are fitted again one after the other, in
    another order, so that none can tell another one anything; None where V stays. fit_alone: of the
    fold at that place."""
    value = float(np.mean([fold.score.value for fold in folds]))
    errors = [fold.diagnostics.train_error for fold in folds]
    if consistency(value, errors) >= FAR_BELOW:
        return None
    again: list[float] = []
    for place in random.permutation(len(folds)).tolist():
        result = fit_alone(place)
        if isinstance(result, Failure):
            words = f"{SuspicionKind.CONSISTENCY}: fitted alone, a fold fails"
            return Failure(Reason.SUSPECT, words, place + 1)
        again.append(result.score.value)
    if np.mean(again) <= _UNLIKE * value:
        return None
    words = "V is far below the training error, but not with the folds fitted one by one"
    return Failure(Reason.SUSPECT, f"{SuspicionKind.CONSISTENCY}: {words}")
