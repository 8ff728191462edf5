"""Options of model families and training methods, with the texts of their classes."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from importlib import import_module
from typing import Any

METHODS = "asia.models.methods"


@dataclass(frozen=True)
class Option:
    """One setting of a family or of a method."""

    name: str
    """Name of the option."""
    default: str
    """Default, as source; "" where it is required."""
    kind: str
    """Type, as source."""
    text: str
    """Description, in sentences."""

    @property
    def line(self) -> str:
        """`name=default` and its first sentence."""
        given = f"{self.name}={self.default}" if self.default else self.name
        return f"`{given}`: {first_sentence(self.text)}"


@cache
def options_of(settings: type) -> tuple[Option, ...]:
    """The fields of a dataclass, each with the text below it.

    Raises:
        ValueError: for another class
    """
    if not is_dataclass(settings):
        raise ValueError(f"{settings.__name__} is no dataclass")
    texts: dict[str, tuple[str, str]] = {}
    for owner in reversed(settings.__mro__):
        if is_dataclass(owner):
            texts.update(_texts(owner))
    return tuple(
        Option(field.name, _default(field), *texts.get(field.name, ("", "")))
        for field in fields(settings)
        if not field.name.startswith("_")
    )


def config_of(package: str, name: str) -> type:
    """The `Config` of a family."""
    return import_module(f"{package}.{name}").Config


def method_of(name: str) -> type:
    """A training method by name."""
    return getattr(import_module(METHODS), name)


def about(settings: type) -> str:
    """The first paragraph that a class says of itself, on one line."""
    return " ".join((inspect.getdoc(settings) or "").split("\n\n")[0].split())


def first_sentence(text: str) -> str:
    """Up to the first full stop that ends one."""
    found = re.match(r"(.+?[.])(?:\s+[A-Z\"]|$)", text)
    return found.group(1) if found else text


def _texts(owner: type) -> dict[str, tuple[str, str]]:
    """Type and text of each field that the class itself has."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    assert isinstance(node, ast.ClassDef)
    answer: dict[str, tuple[str, str]] = {}
    for place, item in enumerate(node.body):
        if not (isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)):
            continue
        below = node.body[place + 1] if place + 1 < len(node.body) else None
        text = ""
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            text = " ".join(str(below.value.value).split())
        answer[item.target.id] = ast.unparse(item.annotation), text
    return answer


def _default(field: Field[Any]) -> str:
    if field.default is MISSING:
        return "" if field.default_factory is MISSING else "its own"
    return repr(field.default)
