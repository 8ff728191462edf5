"""One place for "did you mean"."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher


def nearest(word: str, known: Iterable[str]) -> str:
    """The name in `known` most like `word`, empty when there is none to choose from."""

    def likeness(name: str) -> float:
        return SequenceMatcher(None, word.casefold(), name.casefold()).ratio()

    return max(known, key=likeness, default="")
