"""Lessons in a few lines, for people and for language models."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median, quantiles

from asia.agents._lesson import FIRST_FIT, Lesson
from asia.agents._view import AgentView
from asia.agents.lessons.learn import kind_of
from asia.agents.library.table import families

MOST_LINES = 10


@dataclass(frozen=True)
class Summary:
    """What one move on one family brought."""

    family: str
    """The model family."""
    move: str
    """The move."""
    count: int
    """Times that it was made, failures included."""
    failed: int
    """Times without a score."""
    searches: int
    """Searches in which it was made."""
    middle: float | None
    """Median relative change of V, below 0 is better; None without a score."""
    low: float | None
    """Lower quartile of the change."""
    high: float | None
    """Upper quartile of the change."""

    @property
    def words(self) -> str:
        """The change with its spread and count."""
        tried = f"tried {self.count} times in {self.searches} searches"
        failed = f", {self.failed} failed" if self.failed else ""
        if self.middle is None or self.low is None or self.high is None:
            return f"{tried}, no score"
        return (
            f"V {self.middle:+.0%} (quartiles {self.low:+.0%} to {self.high:+.0%}), {tried}{failed}"
        )


def summaries(lessons: Sequence[Lesson]) -> tuple[Summary, ...]:
    """One for each family and move, first fits first, then the largest gain first."""
    groups: dict[tuple[str, str], list[Lesson]] = defaultdict(list)
    for lesson in lessons:
        groups[lesson.family, lesson.move].append(lesson)
    found = [_summary(family, move, group) for (family, move), group in groups.items()]
    return tuple(sorted(found, key=_order))


def summary_lines(view: AgentView) -> tuple[str, ...]:
    """What the lessons of a search say about problems like this one, for a language model: at most
    `MOST_LINES` lines, () without lessons."""
    if not view.lessons:
        return ()
    kind = kind_of(view.facts, view.linear)
    apart = {lesson: len(kind ^ lesson.kind) for lesson in view.lessons}
    nearest = min(apart.values())
    similar = [lesson for lesson in view.lessons if apart[lesson] <= nearest + 2]
    rows = {row.name for row in families(view.facts)}
    found = summaries([lesson for lesson in similar if lesson.family in rows])
    known = [s for s in found if s.middle is not None and s.count > 1] or list(found)
    first = [s for s in known if s.move == FIRST_FIT][: MOST_LINES // 2]
    moves = [s for s in known if s.move != FIRST_FIT][: MOST_LINES - len(first)]
    return tuple(_lines((*first, *moves)))


def _lines(found: Sequence[Summary]) -> Iterator[str]:
    for one in found:
        against = " against the best linear model" if one.move == FIRST_FIT else ""
        yield f"{one.family}, {one.move}: {one.words}{against}"


def _summary(family: str, move: str, group: Sequence[Lesson]) -> Summary:
    changes = [math.expm1(-lesson.gain) for lesson in group if lesson.gain is not None]
    failed = len(group) - len(changes)
    searches = len({lesson.run for lesson in group})
    if not changes:
        return Summary(family, move, len(group), failed, searches, None, None, None)
    low, _, high = quantiles(changes, n=4, method="inclusive") if len(changes) > 1 else changes * 3
    return Summary(family, move, len(group), failed, searches, median(changes), low, high)


def _order(one: Summary) -> tuple[bool, float, str, str]:
    middle = math.inf if one.middle is None else one.middle
    return one.move != FIRST_FIT, middle, one.family, one.move
