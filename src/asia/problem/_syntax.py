"""Parsing Python text, in several threads at once."""

from __future__ import annotations

import ast
import sys
from typing import Literal, overload

_ATTEMPTS = 100


@overload
def syntax_tree(text: str, name: str) -> ast.Module: ...
@overload
def syntax_tree(text: str, name: str, mode: Literal["eval"]) -> ast.Expression: ...


def syntax_tree(
    text: str, name: str, mode: Literal["exec", "eval"] = "exec"
) -> ast.Module | ast.Expression:
    """`ast.parse`, and raises as it does.

    CPython 3.11 counts the depth of all threads' trees in one place: where another thread parses
    while the collector runs, a sound text ends in a SystemError. It is then parsed again.
    """
    for _ in range(_ATTEMPTS if sys.version_info < (3, 12) else 0):
        try:
            return ast.parse(text, name, mode)
        except SystemError:
            continue
    return ast.parse(text, name, mode)
