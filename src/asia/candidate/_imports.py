"""Libraries that a candidate will import, read from its source and from the model library."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import asia
from asia._syntax import syntax_tree

JAX = frozenset({"jax"})
_LOAD_JAX = ("jax", "equinox", "optax")
_TRAIN = ("equinox", "optax")
_MODELS = "asia.models"


@dataclass(frozen=True)
class _Imports:
    """Names of imported modules, and of what is imported from them, which may be modules too."""

    first: frozenset[str]
    """Imports by statements that run when the module is imported."""
    later: frozenset[str]
    """Imports by statements inside functions."""


@lru_cache(64)
def imported_libraries(source: str, *, fitting: bool) -> frozenset[str]:
    """Return `JAX` if executing a source loads it, else nothing: no other library takes long to
    load.

    Args:
        source: Python source of a candidate.
        fitting: include what modules of `asia.models` import when they are called; at their top
            those modules import what they cannot do without.
    """
    found = _reached(_imports(source), fitting=fitting)
    return JAX if any(name.split(".")[0] in _LOAD_JAX for name in found) else frozenset()


@lru_cache(64)
def trains_network(source: str) -> bool:
    """Return whether fitting a candidate trains a network, which a GPU can shorten.

    It does with a family of the library that trains one, or with JAX in its own source.
    """
    own = _imports(source)
    if any(name.split(".")[0] in _LOAD_JAX for name in own.first | own.later):
        return True
    return any(name.split(".")[0] in _TRAIN for name in _reached(own, fitting=True))


def _reached(own: _Imports, *, fitting: bool) -> set[str]:
    """Modules that a source imports directly or through the library."""
    found, queue, seen = set(own.first), [*own.first], set[str]()
    while queue:
        name = queue.pop()
        if name in seen or not f"{name}.".startswith(f"{_MODELS}."):
            continue
        seen.add(name)
        inside = _imports_of_module(name)
        found |= inside.first
        queue += [*inside.first, *(inside.later if fitting else ())]
    return found


@cache
def _imports_of_module(name: str) -> _Imports:
    """Imports of a module of this package; none if there is no such module."""
    place = Path(asia.__file__).parent.joinpath(*name.split(".")[1:])
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            return _imports(path.read_text("utf-8"))
    return _Imports(frozenset(), frozenset())


def _imports(source: str) -> _Imports:
    try:
        tree = syntax_tree(source, "candidate.py")
        first = frozenset(_names(tree.body, inside=False))
        return _Imports(first, frozenset(_names(tree.body, inside=True)) - first)
    except (SyntaxError, ValueError):
        return _Imports(frozenset(), frozenset())


def _names(body: list[ast.stmt], *, inside: bool) -> Iterator[str]:
    """Names that the statements import, those in functions only if `inside`. Statements for type
    checkers are left out."""
    for node in body:
        match node:
            case ast.Import():
                yield from (alias.name for alias in node.names)
            case ast.ImportFrom() if node.module and not node.level:
                yield node.module
                yield from (f"{node.module}.{alias.name}" for alias in node.names)
            case ast.FunctionDef() | ast.AsyncFunctionDef() if inside:
                yield from _names(node.body, inside=inside)
            case ast.If() if "TYPE_CHECKING" not in ast.dump(node.test):
                yield from _names([*node.body, *node.orelse], inside=inside)
            case ast.ClassDef() | ast.With() | ast.For() | ast.While():
                yield from _names(node.body, inside=inside)
            case ast.Try():
                yield from _names([*node.body, *node.orelse, *node.finalbody], inside=inside)
            case _:
                pass
