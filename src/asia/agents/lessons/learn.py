"""From a search, as its agent saw it, to lessons: V of the cross-validation, and nothing else."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import cache

from asia.agents._lesson import FIRST_FIT, LARGEST_GAIN, Lesson
from asia.agents._view import AgentView, Facts, Trial
from asia.agents.expert.moves import all_moves
from asia.agents.expert.titles import plain_title
from asia.agents.library.recipe import read_recipe
from asia.agents.library.table import family
from asia.agents.library.traits import traits

# Where V of the best linear model says that it explains nearly all, and that it explains little.
_LINEAR_ENOUGH, _FAR_FROM_LINEAR = 0.1, 0.4


def kind_of(facts: Facts, linear: float | None) -> frozenset[str]:
    """The kind of system: the traits of the problem, whether it has several inputs, and how far the
    best linear model comes. linear: its V, None where it has none."""
    words: set[str] = set(traits(facts))
    if len(facts.inputs) > 1:
        words.add("several inputs")
    if linear is not None:
        words.add(
            "nearly linear"
            if linear < _LINEAR_ENOUGH
            else "far from linear"
            if linear > _FAR_FROM_LINEAR
            else "partly linear"
        )
    return frozenset(words)


def learn(view: AgentView, run: str = "") -> tuple[Lesson, ...]:
    """A lesson for each trial that is the first fit of a family of the library, or a move of the
    expert's from a trial with a score. run: digest of the search."""
    kind = kind_of(view.facts, view.linear)
    return tuple(
        Lesson(run, kind, known, move, _gain(before, trial))
        for trial, known, move, before in _moves(view)
    )


def _moves(view: AgentView) -> Iterator[tuple[Trial, str, str, float]]:
    """Trial, family, move, and V before it."""
    by_number = {trial.number: trial for trial in view.trials}
    tried: set[str] = set()
    for trial in view.trials:
        recipe = read_recipe(trial.source)
        row = None if recipe is None else family(recipe.family)
        if row is None or trial.family == "baseline":
            continue
        parent = by_number.get(trial.parent or 0)
        move = move_named(plain_title(trial.title).removeprefix(f"{row.label}: "))
        if row.name not in tried and parent is None:
            reference = _reference(view)
            if reference:
                yield trial, row.name, FIRST_FIT, reference
        elif move is not None and parent is not None and parent.value:
            yield trial, row.name, move, parent.value
        tried.add(row.name)


def move_named(words: str) -> str | None:
    """The name of the expert's move that a title tells, with `{state}` where it names a state; None
    for other titles."""
    for name, pattern in _patterns():
        if pattern.fullmatch(words):
            return name
    return None


@cache
def _patterns() -> tuple[tuple[str, re.Pattern[str]], ...]:
    """Names without a state first: that of another move may fit into the place of a state."""
    names = sorted({move.name for move in all_moves()}, key=lambda name: ("{" in name, name))
    return tuple((n, re.compile(re.escape(n).replace(r"\{state\}", r".+"))) for n in names)


def _reference(view: AgentView) -> float | None:
    """V of the best linear model; of the first experiment where that has none."""
    if view.linear:
        return view.linear
    return view.trials[0].value if view.trials else None


def _gain(before: float, trial: Trial) -> float | None:
    if trial.value is None:
        return None
    gain = math.log(before) - math.log(max(trial.value, 1e-12))
    return min(max(gain, -LARGEST_GAIN), LARGEST_GAIN)
