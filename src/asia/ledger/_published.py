"""Scores that agents may see.

The Ladder (Blum and Hardt, ICML 2015): a score is reported only if it is lower than the last
reported one by a step, and then rounded to a grid of steps. So the information in the reported
scores of any number of candidates is bounded by the number of steps. V has no upper limit, so the
step is relative and the grid geometric. As in their parameter-free form, the gain must exceed its
own scatter. Here this is the scatter over parts of the held-out records, because the errors of
single samples are correlated in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean, stdev

from asia.errors import Reason
from asia.ledger._view import SearchView
from asia.scoring import Score

_DEVIATIONS = 3.0


def beats(score: Score, view: SearchView) -> bool:
    """Return whether a score is a new best.

    It must be below V of the incumbent. With the Ladder it must be below the reported V by more
    than the step, and better over the parts by three standard errors.
    """
    best = view.best.score if view.best else None
    if best is None:
        return True
    step = view.started.ladder
    if step is None:
        return score.value < best.value
    if not score.value < on_ladder(best.value, step) * (1.0 - step):
        return False
    return _stands_out([a - b for a, b in zip(_parts(best), _parts(score), strict=True)])


def on_ladder(value: float, step: float) -> float:
    """The nearest power of 1 - `step`."""
    return (1.0 - step) ** round(math.log(value) / math.log1p(-step)) if value > 0 else 0.0


def published(view: SearchView) -> SearchView:
    """The view with the reported scores; unchanged without the Ladder. With it, an experiment that
    was kept has its V on the grid. Any other with a score has the last reported V. None has scores
    of its folds. A failure that depends on held-out outputs is reported, once a V was, as a score
    that was not kept."""
    step = view.started.ladder
    if step is None:
        return view
    reported: float | None = None
    experiments = list(view.experiments)
    for i, experiment in enumerate(experiments):
        result, score, failure = experiment.result, experiment.score, experiment.failure
        hidden = failure is not None and failure.reason is Reason.RESTART
        if result is None or not (score or (hidden and reported is not None)):
            continue
        if score and (reported is None or result.status == "keep"):
            reported = on_ladder(score.value, step)
        assert reported is not None
        status = "discard" if hidden else result.status
        result = replace(result, status=status, outcome=Score(reported, ()))
        experiments[i] = replace(experiment, result=result)
    return replace(view, experiments=tuple(experiments))


def _parts(score: Score) -> list[float]:
    return [part for fold in score.folds for part in fold.parts]


def _stands_out(gains: Sequence[float]) -> bool:
    if len(gains) < 2:
        return False
    return fmean(gains) > _DEVIATIONS * stdev(gains) / math.sqrt(len(gains))
