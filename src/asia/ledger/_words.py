"""One-line descriptions of failures."""

from __future__ import annotations

import re

from asia._text import one_line
from asia.ledger._events import HandedOver, HandOverReason, Validated
from asia.ledger._events.search import Phase

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


def hand_over_words(event: HandedOver) -> str:
    """`bayes takes over after #05; stop reason of the previous agent: experiments spent`."""
    detail = f" ({event.detail})" if event.detail else ""
    return (
        f"{event.agent} takes over after #{event.after:02d}; stop reason of the previous agent: "
        f"{_ENDED[event.reason]}{detail}"
    )


def dossier_words(event: Validated) -> str:
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


def phase_words(phase: Phase) -> str:
    """Describe the part of the budget in which an experiment lies. Its hypothesis is the agent's
    choice.
    """
    return _PHASES[phase]
