"""The one contract of the page's sections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from asia.report._page.html import Html, tag
from asia.report._page.subject import Subject


@dataclass(frozen=True)
class Section:
    """A part of the page: one module below `sections`, and one line in its `__init__`."""

    key: str
    """Its anchor."""
    title: str
    """Its heading."""
    write: Callable[[Subject], Html | None]
    """Function that writes the section below its title; None if the run has nothing for it. Numbers
    come from `Subject.number` and similar methods, foreign texts go through `html.said`; the audit
    refuses a page with any other digit.
    """


def used_no_test(after_unsealing: bool) -> Html | None:
    """Return the note on evidence that was computed after the test was opened."""
    if not after_unsealing:
        return None
    return tag("p", "This was computed after the sealed test had been opened, without using it.")
