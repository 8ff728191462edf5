"""Text of ledger events and experiments, one line each."""

from __future__ import annotations

import re
from statistics import fmean

from asia._text import one_line
from asia.ledger.events import Evaluated, HandedOver, HandOverReason, Phase, Validated
from asia.ledger.view import Experiment, SearchView

_FRAME = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d+)')

_PHASES: dict[Phase, str] = {
    "baseline": "the baseline",
    "explore": "early in the budget",
    "refine": "later in the budget",
}
_ENDED: dict[HandOverReason, str] = {
    "planned": "experiments spent",
    "saturated": "no improvement in the last experiments",
    "exhausted": "no proposals left",
    "stuck": "no progress",
    "tokens": "tokens spent",
    "cost": "money spent",
    "time": "time spent",
    "agent": "it ended",
}


def hand_over_text(event: HandedOver) -> str:
    """`bayes takes over after #05; stop reason of the previous agent: experiments spent`."""
    detail = f" ({event.detail})" if event.detail else ""
    return (
        f"{event.agent} takes over after #{event.after:02d}; stop reason of the previous agent: "
        f"{_ENDED[event.reason]}{detail}"
    )


def validation_summary(event: Validated) -> str:
    """`pass 7, doubt 2, fail 1: the residual of level drifts with time`."""
    counts = f"pass {event.passed}, doubt {event.doubtful}, fail {event.failed}"
    where = f" on {event.record}" if event.record else ""
    worst = next((c.sentence for c in event.checks if c.name == event.worst), "")
    return f"{counts}{where}: {worst}" if worst else f"{counts}{where}"


def error_line(error: str, most: int = 300) -> str:
    """The last line of a failure, with the line of candidate.py that raised it; "" for none."""
    lines = error.strip().splitlines()
    if not lines:
        return ""
    frames = _FRAME.findall(error)
    where = f"line {frames[-1]}: " if frames else ""
    return one_line(f"{where}{lines[-1]}", most)


def phase_text(phase: Phase) -> str:
    """Describe the part of the budget in which an experiment lies. Its hypothesis is the agent's
    choice.
    """
    return _PHASES[phase]


def seed_mean_words(e: Experiment) -> str:
    """`mean of 3 seeds 0.1312`, which decides whether its method is kept; "" for a single fit."""
    values = e.seed_values
    if len(values) < 2:
        return ""
    return f"mean of {len(values)} seeds {error_value(fmean(values))}"


def validation_score_words(result: Evaluated) -> str:
    """Describe the number of requests of an experiment for its score on the held-out parts."""
    count = result.validation_scores
    return f"{count} validation score{'' if count == 1 else 's'}"


def error_value(value: float) -> str:
    """Four decimals; powers of ten where a simulation ran away."""
    return f"{value:.4f}" if value < 1e4 else f"{value:.2e}"


def describe_result(e: Experiment, view: SearchView) -> str:
    """Describe a result in one line: V and its folds, or the failure with advice."""
    left = e.result.left_behind if e.result else ()
    stuck = f"; worker process {', '.join(map(str, left))} could not be terminated" if left else ""
    return _outcome_text(e, view) + stuck


def _outcome_text(e: Experiment, view: SearchView) -> str:
    if e.score and e.result:
        folds = ", ".join(error_value(f.value) for f in e.score.folds)
        asked = (
            ""
            if view.started.early_stopping == "inner"
            else f", {validation_score_words(e.result)}"
        )
        parts = f" (folds {folds}{asked})" if folds else ""
        return f"{view.v_name} = {error_value(e.score.value)}{parts}{_retest_text(e)}"
    if e.failure:
        where = f" in fold {e.failure.fold}" if e.failure.fold else ""
        message = error_line(e.failure.detail)
        detail = f" ({message})" if message else ""
        return f"no score{where}: {e.failure.advice}{detail}"
    return "being evaluated"


def _retest_text(e: Experiment) -> str:
    """`; repeated fits 0.1352, 0.1298, mean of 3 seeds 0.1320; required: a mean 0.0031 below the
    incumbent's`."""
    assert e.result is not None
    values = [r.failed if r.value is None else error_value(r.value) for r in e.result.retests]
    text = f"; repeated fits {', '.join(values)}" if values else ""
    if mean := seed_mean_words(e):
        text += f", {mean}"
    if any(r.same for r in e.result.retests):
        text = "; equal with another seed"
    if e.result.floor:
        text += f"; required: a mean {e.result.floor:.2g} below the incumbent's"
    return text
