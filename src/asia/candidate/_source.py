"""Check and identify the source of a candidate before anything of it runs."""

from __future__ import annotations

import ast
import hashlib
import warnings

from asia._syntax import syntax_tree
from asia.candidate._lint import check_content, without_words
from asia.errors import CandidateError, Reason

LARGEST_SOURCE = 64 * 1024


def check_source(source: str) -> None:
    """Refuse a source that cannot be a candidate, without executing it.

    Raises:
        CandidateError: SYNTAX if it does not parse, CONTRACT if it defines no top-level name `fit`,
            LITERAL_DATA if it is over 64 KB or carries more data than a model needs.
    """
    tree = _parse(source)
    if "fit" not in _defined(tree.body):
        raise CandidateError(
            Reason.CONTRACT, "the source defines no top-level function fit(trajectories, context)"
        )
    check_content(source, tree)


def executed_source(source: str) -> str:
    """Source that a worker executes: without comments and docstrings, which could carry data.

    Lines keep their numbers.

    Raises:
        CandidateError: as for `check_source`.
    """
    return without_words(source, _parse(source))


def source_digest(source: str) -> str:
    """Digest of the normalised syntax tree: comments, docstrings and layout do not count.

    Returns:
        sha256 in hex.

    Raises:
        CandidateError: as for `check_source`, if the source does not parse.
    """
    tree = _parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            _drop_docstring(node)
    return hashlib.sha256(ast.dump(tree).encode("utf-8", "surrogatepass")).hexdigest()


def _parse(source: str) -> ast.Module:
    try:
        size = len(source.encode())
    except UnicodeEncodeError as error:
        raise CandidateError(Reason.SYNTAX, "the source is not valid Unicode") from error
    if size > LARGEST_SOURCE:
        raise CandidateError(
            Reason.LITERAL_DATA,
            f"the source has {size} bytes, at most {LARGEST_SOURCE} are allowed",
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return syntax_tree(source, "candidate.py")
    except SyntaxError as error:
        where = "" if error.lineno is None else f"line {error.lineno}: "
        raise CandidateError(Reason.SYNTAX, f"{where}{error.msg}") from error
    except ValueError as error:
        raise CandidateError(Reason.SYNTAX, str(error)) from error


def _defined(body: list[ast.stmt]) -> set[str]:
    """Names that the statements of a module bind, `if` and `try` blocks included."""
    names: set[str] = set()
    for node in body:
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.Import(names=aliases) | ast.ImportFrom(names=aliases):
                names |= {alias.asname or alias.name for alias in aliases}
            case ast.Assign(targets=targets):
                names |= {t.id for target in targets for t in _targets(target)}
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr()):
                names.add(name)
            case ast.If(body=first, orelse=second):
                names |= _defined(first) | _defined(second)
            case ast.Try(body=first, orelse=second, finalbody=third):
                names |= _defined(first) | _defined(second) | _defined(third)
                names |= {name for handler in node.handlers for name in _defined(handler.body)}
            case _:
                pass
    return names


def _targets(target: ast.expr) -> list[ast.Name]:
    if isinstance(target, ast.Name):
        return [target]
    if isinstance(target, ast.Tuple | ast.List):
        return [name for element in target.elts for name in _targets(element)]
    return []


def _drop_docstring(
    node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef,
) -> None:
    match node.body:
        case [ast.Expr(value=ast.Constant(value=str())), *rest]:
            node.body = rest
        case _:
            pass
