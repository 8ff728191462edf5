"""Commands whose parameters are groups of options: one dataclass a group, one field an option."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import wraps
from typing import Any, get_type_hints


def with_groups(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer sees it: each parameter that is annotated with a dataclass is replaced
    by the fields of that dataclass, which keep their annotations and defaults."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}

    @wraps(command)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        command(**given)

    own = inspect.signature(command).parameters
    shown = [p for name in own for p in _parameters(own[name], hints[name])]
    called.__signature__ = inspect.Signature(shown)  # pyright: ignore[reportAttributeAccessIssue]
    called.__annotations__ = {p.name: p.annotation for p in shown}
    return called


def given(group: Any, *, leave_out: tuple[str, ...] = ()) -> dict[str, object]:
    """The options of a group that differ from their defaults, by name."""
    return {
        f.name: getattr(group, f.name)
        for f in fields(group)
        if f.name not in leave_out and getattr(group, f.name) != f.default
    }


def _parameters(own: inspect.Parameter, hint: Any) -> Iterator[inspect.Parameter]:
    if not is_dataclass(hint):
        yield _parameter(own.name, hint, own.default)
        return
    hints = get_type_hints(hint, include_extras=True)
    for field in fields(hint):
        yield _parameter(field.name, hints[field.name], _default(field))


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, annotation=annotation, default=default)


def _default(field: Field[Any]) -> Any:
    return inspect.Parameter.empty if field.default is MISSING else field.default
