"""Suggestions for misspelt names ("did you mean")."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def suggestion(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest known name, else nothing."""
    names = {name.casefold(): name for name in known if name}
    close = get_close_matches(word.casefold(), names, n=1, cutoff=0.5)
    return f"; did you mean '{names[close[0]]}'?" if close else ""


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest known name, else the list of what is known."""
    names = [name for name in known if name]
    close = suggestion(word, names)
    return close or (f"; known: {', '.join(names)}" if names else "")
