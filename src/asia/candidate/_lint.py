"""Limits on the data that a source carries. A candidate learns from its training records; one that
contains numbers may have copied them from the answers."""

from __future__ import annotations

import ast
import io
import tokenize
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from asia._syntax import syntax_tree
from asia.errors import CandidateError, Reason

MOST_LITERALS = 1024
MOST_NAMES = 2048
MOST_ALIKE = 1024
MOST_CODE = 7 * 1024

_NAMED = ("name", "id", "attr", "arg", "asname", "module")
_SIGNS = (ast.operator, ast.unaryop, ast.cmpop, ast.boolop)


@dataclass(frozen=True)
class SourceContent:
    """Information in a source, in bytes after DEFLATE compression.

    Comments and docstrings do not count, since a candidate runs without them.
    """

    literals: int
    """Bytes of numbers, strings and bytes literals."""
    names: int
    """Bytes of names."""
    alike: int
    """Bytes of names, operators and order in statements of the same structure, for the structure
    with the most; a table, in names or in operators, of one statement or of many, is one structure.
    """
    code: int
    """Bytes of the whole source."""


def content(source: str, tree: ast.Module) -> SourceContent:
    """Measure the information in a source.

    Args:
        source: Python source.
        tree: the same source, parsed.

    Raises:
        CandidateError: as for `without_words`.
    """
    docstrings = _docstrings(tree)
    literals: list[bytes] = []
    names: dict[str, None] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node not in docstrings:
            literals.append(_literal(node.value))
        names.update(dict.fromkeys(_names(node)))
    return SourceContent(
        _deflated(b"\n".join(literals)),
        _deflated("\n".join(names).encode("utf-8", "replace")),
        _alike(tree),
        _deflated(without_words(source, tree).encode("utf-8", "replace")),
    )


def check_content(source: str, tree: ast.Module) -> None:
    """Refuse a source that carries more data than a model needs.

    Raises:
        CandidateError: LITERAL_DATA.
    """
    found = content(source, tree)
    for what, size, most in (
        ("numbers and strings", found.literals, MOST_LITERALS),
        ("names", found.names, MOST_NAMES),
        ("statements of one kind", found.alike, MOST_ALIKE),
        ("code", found.code, MOST_CODE),
    ):
        if size > most:
            raise CandidateError(
                Reason.LITERAL_DATA,
                f"its {what} hold {size} bytes when compressed, at most {most} are allowed",
            )


def without_words(source: str, tree: ast.Module) -> str:
    """Remove comments and docstrings from a source, so that neither can carry data into a worker.

    Lines keep their numbers.

    Raises:
        CandidateError: SYNTAX, if the layout does not permit telling comments from code.
    """
    lines = source.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    spans = [(w.lineno, w.col_offset, w.end_lineno, w.end_col_offset) for w in _docstrings(tree)]
    for first, start, last, end in sorted(spans, key=lambda span: span[:2], reverse=True):
        assert last is not None
        head = lines[first - 1].encode()[:start].decode()
        tail = lines[last - 1].encode()[end:].decode()
        lines[first - 1 : last] = f'{head}(""{chr(10) * (last - first)}){tail}'.split("\n")
    text = "\n".join(lines)
    try:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                row, column = token.start
                lines[row - 1] = lines[row - 1][:column]
        bare = "\n".join(lines)
        if _nodes(_parsed(bare)) == _nodes(tree):
            return bare
    except (tokenize.TokenError, SyntaxError, ValueError):
        pass
    raise CandidateError(
        Reason.SYNTAX, "comments cannot be separated from code: use plain line ends and indents"
    )


def _alike(tree: ast.Module) -> int:
    kinds: dict[frozenset[str], list[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt):
            parts = list(_parts(node))
            kind = frozenset(type(p).__name__ for p in parts if not isinstance(p, _SIGNS))
            kinds.setdefault(kind, []).extend(_shape(p) for p in parts)
    sizes = (_deflated("\n".join(k).encode("utf-8", "replace")) for k in kinds.values())
    return max(sizes, default=0)


def _parts(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of a statement in the order they are written, without the statements inside it."""
    left: list[ast.AST] = [statement]
    while left:
        node = left.pop()
        yield node
        inside = [c for c in ast.iter_child_nodes(node) if not isinstance(c, ast.stmt)]
        left += [c for c in reversed(inside) if not isinstance(c, ast.expr_context)]


def _parsed(text: str) -> ast.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return syntax_tree(text, "candidate.py")


def _docstrings(tree: ast.Module) -> set[ast.Constant]:
    """Docstrings of modules, functions and classes, and strings below a field or a constant."""
    found: set[ast.Constant] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            several = not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for statement in node.body if several else node.body[:1]:
                match statement:
                    case ast.Expr(value=ast.Constant(value=str()) as text):
                        found.add(text)
                    case _:
                        pass
    return found


def _nodes(tree: ast.Module) -> list[str]:
    """Descriptions of the tree's nodes, without docstrings."""
    docstrings = _docstrings(tree)
    return [
        repr(node.value) if isinstance(node, ast.Constant) else _shape(node)
        for node in ast.walk(tree)
        if node not in docstrings
    ]


def _shape(node: ast.AST) -> str:
    return " ".join((type(node).__name__, *_names(node)))


def _names(node: ast.AST) -> Iterator[str]:
    for field in _NAMED:
        value = getattr(node, field, None)
        if isinstance(value, str):
            yield value
    if isinstance(node, ast.Global | ast.Nonlocal):
        yield from node.names


def _literal(value: object) -> bytes:
    if isinstance(value, bytes):
        return value
    text = value if isinstance(value, str) else repr(value)
    return text.encode("utf-8", "replace")


def _deflated(data: bytes) -> int:
    return len(zlib.compress(data, 9, wbits=-zlib.MAX_WBITS))
