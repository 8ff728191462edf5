"""Groups of options as dataclasses, one field per option; short and full help."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterator
from copy import copy
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo, ParameterInfo

from asia._text import say

_ALL = "help_all"


def with_groups(
    command: Callable[..., None], brief_help: Collection[str] | None = None
) -> Callable[..., None]:
    """Return the command for typer. Each parameter annotated with a dataclass is replaced by the
    fields of that dataclass, which keep their annotations and defaults. The option `--help-all`
    shows the options that `--help` hides.

    brief_help: parameters that `--help` shows; None: all that are not declared hidden."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}

    @wraps(command)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{f.name: given.pop(f.name) for f in fields(group)})
        given.pop(_ALL)
        command(**given)

    own = inspect.signature(command).parameters
    shown = [p for name in own for p in _parameters(own[name], hints[name])]
    if brief_help is not None:
        shown = [p if p.name in brief_help else _hidden(p) for p in shown]
    shown.append(_parameter(_ALL, _help_all(any(map(_is_hidden, shown))), False))
    called.__signature__ = inspect.Signature(shown)  # pyright: ignore[reportAttributeAccessIssue]
    called.__annotations__ = {p.name: p.annotation for p in shown}
    return called


def _help_all(useful: bool) -> Any:
    """Annotation of `--help-all`; itself hidden for a command that hides nothing."""

    def show(ctx: typer.Context, wanted: bool) -> None:
        if wanted:
            for parameter in ctx.command.params:
                parameter.hidden = False  # pyright: ignore[reportAttributeAccessIssue]
            say(ctx.get_help())
            raise typer.Exit

    option = typer.Option(
        "--help-all",
        is_eager=True,
        callback=show,
        hidden=not useful,
        help="Show all options and exit.",
    )
    return Annotated[bool, option]


def _info(parameter: inspect.Parameter) -> ParameterInfo | None:
    """Declaration of an option or an argument."""
    notes = (
        get_args(parameter.annotation)[1:] if get_origin(parameter.annotation) is Annotated else ()
    )
    return next((n for n in notes if isinstance(n, ParameterInfo)), None)


def _is_hidden(parameter: inspect.Parameter) -> bool:
    found = _info(parameter)
    return isinstance(found, OptionInfo) and found.hidden


def _hidden(parameter: inspect.Parameter) -> inspect.Parameter:
    found = _info(parameter)
    if found is None or isinstance(found, ArgumentInfo):
        return parameter
    found = copy(found)
    found.hidden = True
    kind = get_args(parameter.annotation)[0]
    return parameter.replace(annotation=Annotated[kind, found])


def given(group: Any, *, leave_out: tuple[str, ...] = ()) -> dict[str, object]:
    """Return the options of a group that differ from their defaults, by name."""
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
