"""Settings that every `Config` and every training method checks, and the progress of a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from asia.errors import UserError

Progress: TypeAlias = Callable[[float, float], None]
"""Takes the number of steps or iterations done and the loss, as `Context.log` does."""


def demand(settings: object, name: str, holds: bool, expected: str) -> None:
    """Raises UserError, which says what `name` is and what was expected, unless it holds."""
    if not holds:
        value = getattr(settings, name)
        raise UserError(f"{owner(settings)}: {name} is {value!r}, expected {expected}")


def check_at_least(low: int, settings: object, *names: str) -> None:
    """Raises UserError where a setting is less than `low`; None, which leaves one open, passes."""
    for name in names:
        value = getattr(settings, name)
        demand(settings, name, value is None or value >= low, f"at least {low}")


def check_choice(settings: object, name: str, known: Sequence[object]) -> None:
    """Raises UserError where a setting is none of those known."""
    words = [str(value) for value in known]
    expected = f"{', '.join(words[:-1])} or {words[-1]}"
    demand(settings, name, getattr(settings, name) in known, expected)


def owner(settings: object) -> str:
    """What a message calls these settings: "koopman.Config", "Adam"."""
    found = type(settings)
    if found.__name__ != "Config":
        return found.__name__
    return f"{found.__module__.rpartition('.')[2]}.Config"
