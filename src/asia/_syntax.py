"""Parsing Python text, in several threads at once."""

from __future__ import annotations

import ast
from collections.abc import Callable
from typing import TypeVar

_ATTEMPTS = 100

T = TypeVar("T")


def syntax_tree(text: str, name: str) -> ast.Module:
    """Of a file's text; raises as `ast.parse`."""
    return _again(lambda: ast.parse(text, name))


def expression_tree(text: str) -> ast.Expression:
    """Of an expression; raises as `ast.parse`."""
    return _again(lambda: ast.parse(text, mode="eval"))


def _again(parse: Callable[[], T]) -> T:
    """CPython 3.11 counts the depth of all threads' trees in one place: where another thread parses
    while the collector runs, a sound text ends in a SystemError."""
    for _ in range(_ATTEMPTS):
        try:
            return parse()
        except SystemError:
            continue
    return parse()
