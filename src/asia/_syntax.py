"""Parsing Python text, in several threads at once."""

import ast
from collections.abc import Callable
from typing import TypeVar

MOST_NESTED = 200
"""Levels of a syntax tree. Python walks and compiles a tree by recursion, and how deep it gets
depends on where it is called."""
MOST_DIGITS = 4300
"""Decimal digits of an integer. CPython turns no longer one into text."""
_TOO_LARGE = 10**MOST_DIGITS
_ATTEMPTS = 100

_TOO_DEEP = f"the source is nested too deeply, at most {MOST_NESTED} levels are allowed"

T = TypeVar("T")


def syntax_tree(text: str, name: str) -> ast.Module:
    """Parse a file's text. Raises as `ast.parse`, and SyntaxError for a tree that Python parses but
    can neither print nor compile: one nested too deeply, or with a huge integer."""
    try:
        tree = _again(lambda: ast.parse(text, name))
    except (RecursionError, MemoryError):
        raise SyntaxError(_TOO_DEEP) from None
    level: list[ast.AST] = [tree]
    for _ in range(MOST_NESTED):
        for node in level:
            match node:
                case ast.Constant(value=int(value)) if abs(value) >= _TOO_LARGE:
                    message = f"an integer has more than {MOST_DIGITS} digits"
                    raise SyntaxError(message, (name, node.lineno, None, None))
                case _:
                    pass
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        if not level:
            return tree
    raise SyntaxError(_TOO_DEEP)


def expression_tree(text: str) -> ast.Expression:
    """Parse an expression; raises as `ast.parse`."""
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
