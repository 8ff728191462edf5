"""Lessons as a prior over moves: by how much a weight grows or shrinks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from asia.agents._lesson import FIRST_FIT, Lesson
from asia.agents._view import AgentView
from asia.agents.lessons.learn import kind_of, learn

# A search in which no move gained more than this gained nothing.
_LEAST_GAIN = 0.002
_OTHER_FAMILY = 0.3
_LARGEST = 2.0
# As many lessons about a move as weigh like knowing nothing of it, and forecasts that do so.
_SHRINKAGE = 3.0
_TRUST = 2.0
_SAYS_SOMETHING = 1.1


@dataclass(frozen=True)
class LessonWeights:
    """What lessons say about the moves of a search.

    A lesson counts half for each trait in which its problem differs from this one. What a move
    brought is shrunk to the mean over all moves, as a few lessons say little. Where the search
    itself went against what the lessons said, all of them count less.
    """

    lessons: tuple[Lesson, ...]
    """From earlier searches."""
    view: AgentView
    """This search so far."""

    def multiplier(self, family: str, move: str) -> float:
        """What the weight of a move is multiplied by, 1/2 to 2; 1 where nothing is known."""
        return self._expected(family, move) ** self.trust

    @cached_property
    def trust(self) -> float:
        """1 for a search that agrees with its lessons, or has none yet; nearer to 0 the more of
        its own trials they were wrong about."""
        own = learn(self.view)
        mean = {first: _mean(_scored(self._weighted, first)) for first in (True, False)}
        right = wrong = 0
        for lesson, score in _scores(own):
            expected = self._expected(lesson.family, lesson.move)
            if max(expected, 1.0 / expected) > _SAYS_SOMETHING:
                better = score > mean[lesson.move == FIRST_FIT]
                right += better == (expected > 1.0)
                wrong += better != (expected > 1.0)
        return (_TRUST + right) / (_TRUST + right + wrong)

    @cached_property
    def _weighted(self) -> tuple[tuple[Lesson, float, float], ...]:
        """Lesson, score, and how much it counts here."""
        kind = kind_of(self.view.facts, self.view.linear)
        return tuple((one, s, 0.5 ** len(kind ^ one.kind)) for one, s in _scores(self.lessons))

    def _expected(self, family: str, move: str) -> float:
        first = move == FIRST_FIT
        found = _scored(self._weighted, first)
        usual = _mean(found)
        if usual <= 0.0:
            return 1.0
        other = 0.0 if first else _OTHER_FAMILY
        total, count = _SHRINKAGE * usual, _SHRINKAGE
        for lesson, score, weight in found:
            if lesson.move == move:
                counts = weight * (1.0 if lesson.family == family else other)
                total, count = total + counts * score, count + counts
        return min(max(total / count / usual, 1.0 / _LARGEST), _LARGEST)


Weighted = tuple[Lesson, float, float]


def _scored(lessons: Sequence[Weighted], first: bool) -> list[Weighted]:
    return [entry for entry in lessons if (entry[0].move == FIRST_FIT) == first]


def _mean(lessons: Sequence[Weighted]) -> float:
    total = sum(weight for _, _, weight in lessons)
    return sum(score * weight for _, score, weight in lessons) / total if total > 0 else 0.0


def _scores(lessons: Sequence[Lesson]) -> list[tuple[Lesson, float]]:
    """0 to 1. Of a first fit: how near it came to the best first fit of its search, or to the
    linear model where that is better. Of a move: its gain over the largest gain of a move in its
    search, for systems differ in how much there is to gain; a loss costs an experiment, not more.
    """
    best: dict[tuple[str, bool], float] = {}
    for one in lessons:
        which = one.run, one.move == FIRST_FIT
        best[which] = max(best.get(which, 0.0), one.gain or 0.0)
    return [(one, _score(one, best[one.run, one.move == FIRST_FIT])) for one in lessons]


def _score(lesson: Lesson, best: float) -> float:
    if lesson.gain is None:
        return 0.0
    if lesson.move == FIRST_FIT:
        return math.exp(lesson.gain - best)
    return max(lesson.gain, 0.0) / best if best > _LEAST_GAIN else 0.0
