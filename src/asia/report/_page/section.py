"""The one contract of the page's sections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from asia.report._page.html import Html
from asia.report._page.subject import Subject


@dataclass(frozen=True)
class Section:
    """A part of the page: one module below `sections`, and one line in its `__init__`."""

    key: str
    """Its anchor."""
    title: str
    """Its heading."""
    write: Callable[[Subject], Html | None]
    """What stands below the heading; None where the run has nothing for it. Numbers come from
    `Subject.number` and its like, words from elsewhere go through `html.said`; the audit refuses a
    page with any other digit."""
