"""What one experiment of an earlier search taught."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

FIRST_FIT = "first fit"
"""The move that tries a family for the first time."""
LARGEST_GAIN = 50.0
"""Beyond this a gain says no more."""


@dataclass(frozen=True)
class Lesson:
    """One move in one search, and what it brought. No name of a problem or of a signal, and no test
    figure, is in it."""

    run: str
    """Digest of the search that it comes from."""
    kind: frozenset[str]
    """The traits of the problem, see `kind_of`."""
    family: str
    """The model family."""
    move: str
    """Name of the expert's move, or `FIRST_FIT`."""
    gain: float | None
    """Natural logarithm of V before over V after; above 0 is better. Before is the parent's V, for
    a first fit that of the best linear model. None where the candidate had no score."""


def merge(known: Iterable[Lesson], new: Sequence[Lesson]) -> tuple[Lesson, ...]:
    """Both; those of a search that both hold are taken from `new`, for it may have gone on."""
    again = {lesson.run for lesson in new}
    return (*(lesson for lesson in known if lesson.run not in again), *new)
