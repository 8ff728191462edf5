"""Titles of moves; a repeated one names the settings that differ."""

from __future__ import annotations

import re

from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe

_LONGEST = 80
_SUFFIX = re.compile(r" \([^()]*\)$")


def title_of(at: Situation, move: Move, recipe: Recipe) -> str:
    """Return the move's own title; if it was used already, add the changed settings: `neural
    state-space: one state more (order 3 to 4)`."""
    plain = move.title(at)
    used = {known.title for known in at.view.proposed}
    if plain not in used:
        return plain
    before, after = at.recipe, recipe
    names = dict((*before.config, *before.options, *after.config, *after.options))
    pairs = [(name, before.get(name), after.get(name)) for name in names]
    changes = [f"{name} {_value(a)} to {_value(b)}" for name, a, b in pairs if a != b]
    if before.method != after.method:
        changes.insert(0, f"{before.method} to {after.method}")
    # As many of the changes as there is room for, and the parent where an earlier trial has the
    # same changes.
    parent = f"from #{at.trial.number:02d}"
    for words in ([], [parent]):
        for change in changes:
            if len(f"{plain} ({', '.join([*words, change])})") <= _LONGEST:
                words.append(change)
        title = f"{plain} ({', '.join(words)})"
        if words and title not in used:
            return title
    return f"{plain} ({parent})"[:_LONGEST]


def plain_title(title: str) -> str:
    """Remove the additions from the title of a repeated move."""
    return _SUFFIX.sub("", title)


def _value(value: object) -> str:
    """A setting's value, without brackets; `none` where it is not set."""
    if isinstance(value, float):
        return f"{value:.2g}"
    if isinstance(value, tuple):
        return "-".join(str(v) for v in value) or "none"  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    text = str(value).replace("(", "").replace(")", "")
    return "none" if value is None else text
