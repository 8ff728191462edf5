"""What a candidate will import, read from its source and from that of the model library."""

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
    """Names of modules, and of what is imported from them, which may be modules too."""

    first: frozenset[str]
    """By statements that run when the module is imported."""
    later: frozenset[str]
    """By statements inside functions."""


@lru_cache(64)
def imported_libraries(source: str, *, fitting: bool) -> frozenset[str]:
    """`JAX` where executing a source loads it, else nothing: no other library takes long to load.
    fitting: also where what it imports from `asia.models` does so when it is called; modules there
    import at their top what they cannot do without."""
    found = _reached(_imports(source), fitting=fitting)
    return JAX if any(name.split(".")[0] in _LOAD_JAX for name in found) else frozenset()


@lru_cache(64)
def trains_network(source: str) -> bool:
    """Whether fitting a candidate trains a network: with a family of the library that does, or with
    JAX in its own source. Those are the fits that a GPU can shorten."""
    own = _imports(source)
    if any(name.split(".")[0] in _LOAD_JAX for name in own.first | own.later):
        return True
    return any(name.split(".")[0] in _TRAIN for name in _reached(own, fitting=True))


def _reached(own: _Imports, *, fitting: bool) -> set[str]:
    """Modules that a source imports, and that the library does for it."""
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
    """Of a module of this package; none where there is no such module."""
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
    """Of the statements, those in functions only if `inside`. Statements for type checkers are
    left out."""
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
