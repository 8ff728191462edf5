"""Settings that every `Config` and every training method checks, and the progress of a fit."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

from asia.errors import UserError

Progress: TypeAlias = Callable[[float, float], None]
"""Function of the number of completed steps or iterations and the loss, as `Context.log`."""


def demand(settings: object, name: str, holds: bool, expected: str) -> None:
    """Raise a UserError with the present and the expected value of a setting unless `holds`."""
    if not holds:
        value = getattr(settings, name)
        raise UserError(f"{owner(settings)}: {name} is {value!r}, expected {expected}")


def check_at_least(low: int, settings: object, *names: str) -> None:
    """Demand that settings are not less than `low`; None, which leaves one open, passes."""
    for name in names:
        value = getattr(settings, name)
        demand(settings, name, value is None or value >= low, f"at least {low}")


def check_choice(settings: object, name: str, known: Sequence[object]) -> None:
    """Demand that a setting is one of the known values."""
    values = [str(value) for value in known]
    expected = f"{', '.join(values[:-1])} or {values[-1]}"
    demand(settings, name, getattr(settings, name) in known, expected)


def owner(settings: object) -> str:
    """Name of the settings in a message: "koopman.Config", "Adam"."""
    found = type(settings)
    if found.__name__ != "Config":
        return found.__name__
    return f"{found.__module__.rpartition('.')[2]}.Config"
