"""Facts about a candidate's source, from its text and syntax tree alone.

Python's own library is all that this module imports: the process that reads untrusted sources
(`asia._source_reader`) loads nothing else.
"""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

from asia._syntax import syntax_tree


class Imports(NamedTuple):
    """Names of imported modules, and of what is imported from them, which may be modules too."""

    first: frozenset[str] = frozenset()
    """Imports by statements that run when the module is imported."""
    later: frozenset[str] = frozenset()
    """Imports by statements inside functions."""


@dataclass(frozen=True)
class SourceFacts:
    """Facts about a source that Python can parse."""

    digest: str
    """sha256 of the normalised syntax tree: comments, docstrings and layout do not count."""
    bare: str | None
    """Source without comments and docstrings, with the same line numbers; None where the layout
    does not permit telling comments from code."""
    defines_fit: bool
    """Whether a top-level statement binds the name `fit`, or `design` of a controller."""
    imports: Imports
    library_only: bool
    """Whether it does nothing but call families and methods of the library with constants."""


def source_facts(source: str) -> SourceFacts:
    """Read a source. Raises SyntaxError or ValueError where Python cannot parse it."""
    tree = _parsed(source)
    bare = _bare(source, tree, _docstrings(tree))
    return SourceFacts(
        digest=_digest(tree),
        bare=bare,
        defines_fit=bool({"fit", "design"} & _defined(tree.body)),
        imports=imports_of(tree),
        library_only=_library_only(tree),
    )


# Types that annotations of such a source name, by module.
_TYPES = {"collections.abc": "Sequence", "asia.candidate": "Context", "asia.problem": "Trajectory"}


def _library_only(tree: ast.Module) -> bool:
    """A few kinds of statements and expressions are known to be harmless; no other one is. The
    family `simulator` runs code of the user's own."""
    families, methods = (
        {
            alias.asname or alias.name
            for statement in tree.body
            if isinstance(statement, ast.ImportFrom) and statement.module == module
            for alias in statement.names
            if alias.name != "simulator"
        }
        for module in ("asia.models", "asia.models.methods")
    )
    defined = {one.name for one in tree.body if isinstance(one, ast.FunctionDef)}
    bound = families | methods | defined | set(_TYPES.values())
    given = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    assigned = {
        node.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    if (given | assigned) & bound or any(n[0] in "_*" for n in bound | given | assigned):
        return False

    def calls_library(function: ast.expr) -> bool:
        match function:
            case ast.Attribute(value=ast.Name(id=name), attr="Config" | "build" | "train"):
                return name in families
            case ast.Name(id=name):
                return name in defined | methods
            case _:
                return False

    def harmless(node: ast.expr) -> bool:
        match node:
            case ast.Constant():
                return True
            case ast.Name(id=name):
                return name in given | assigned
            case ast.Attribute(value=ast.Name(id=name), attr="train"):
                return name in families
            case ast.UnaryOp(op=ast.USub(), operand=value):
                return harmless(value)
            case ast.Tuple(elts=values) | ast.List(elts=values):
                return all(map(harmless, values))
            case ast.Dict(keys=keys, values=values):
                return all(key is not None and harmless(key) for key in keys) and all(
                    map(harmless, values)
                )
            case ast.Call(func=function, args=values, keywords=named):
                values = [*values, *(one.value for one in named)]
                return calls_library(function) and all(map(harmless, values))
            case _:
                return False

    def allowed(statement: ast.stmt) -> bool:
        match statement:
            case ast.Assign(targets=[ast.Name()], value=value):
                return harmless(value)
            case ast.Return(value=ast.expr() as value):
                return harmless(value)
            case ast.Expr(value=ast.Constant()):
                return True
            case _:
                return False

    def names_type(node: ast.expr | None) -> bool:
        match node:
            case None:
                return True
            case ast.Name(id=name):
                return name in _TYPES.values()
            case ast.Attribute(value=ast.Name(id=name), attr=attr):
                return name in families and attr[0] != "_"
            case ast.Subscript(value=ast.Name(id="Sequence"), slice=inner):
                return names_type(inner)
            case _:
                return False

    def allowed_outside(statement: ast.stmt) -> bool:
        match statement:
            case ast.ImportFrom(module="asia.models" | "asia.models.methods", level=0):
                return True
            case ast.ImportFrom(module=str(module), names=[ast.alias(name, None)], level=0):
                return _TYPES.get(module) == name
            case ast.FunctionDef(body=body, args=ast.arguments(args=plain), returns=returns):
                # Nothing but plain arguments: all else is code that runs with the definition.
                words = [ast.unparse(one) for one in plain]
                result = "" if returns is None else f" -> {ast.unparse(returns)}"
                types = [returns, *(one.annotation for one in plain)]
                return (
                    ast.unparse(statement).startswith(
                        f"def {statement.name}({', '.join(words)}){result}:"
                    )
                    and all(map(names_type, types))
                    and all(map(allowed, body))
                )
            case _:
                return allowed(statement)

    return all(map(allowed_outside, tree.body))


def imports_of(tree: ast.Module) -> Imports:
    """Collect the imports of a module."""
    first = frozenset(_names(tree.body, inside=False))
    return Imports(first, frozenset(_names(tree.body, inside=True)) - first)


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


def _bare(source: str, tree: ast.Module, docstrings: set[ast.Constant]) -> str | None:
    """Blank comments and docstrings, so that neither can carry data into a worker. Lines keep their
    numbers. None if the layout does not permit telling comments from code."""
    text = source.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    try:
        lines = _without_docstrings(lines, docstrings)
        for token in tokenize.generate_tokens(io.StringIO("\n".join(lines)).readline):
            if token.type == tokenize.COMMENT:
                row, column = token.start
                lines[row - 1] = lines[row - 1][:column]
        bare = "\n".join(lines)
        return bare if _nodes(_parsed(bare)) == _nodes(tree) else None
    except (tokenize.TokenError, SyntaxError, ValueError, IndexError):
        return None


def _without_docstrings(lines: list[str], docstrings: set[ast.Constant]) -> list[str]:
    """Replace docstrings by empty strings that span as many lines; columns of the syntax tree count
    bytes."""
    rows = [line.encode() for line in lines]
    starts = [0]
    for row in rows:
        starts.append(starts[-1] + len(row) + 1)
    whole, parts, end = b"\n".join(rows), list[bytes](), 0
    for one in sorted(docstrings, key=lambda one: (one.lineno, one.col_offset)):
        assert one.end_lineno is not None
        assert one.end_col_offset is not None
        begin = starts[one.lineno - 1] + one.col_offset
        parts += [whole[end:begin], b'(""', b"\n" * (one.end_lineno - one.lineno), b")"]
        end = starts[one.end_lineno - 1] + one.end_col_offset
    return b"".join([*parts, whole[end:]]).decode().split("\n")


def _parsed(text: str) -> ast.Module:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return syntax_tree(text, "candidate.py")


def _docstrings(tree: ast.Module) -> set[ast.Constant]:
    """Docstrings of modules, functions and classes, and strings below a field or a constant."""
    found: set[ast.Constant] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            one = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for statement in node.body[:1] if one else node.body:
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


def _digest(tree: ast.Module) -> str:
    """Docstrings are taken out of the tree."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            match node.body:
                case [ast.Expr(value=ast.Constant(value=str())), *rest]:
                    node.body = rest
                case _:
                    pass
    return hashlib.sha256(ast.dump(tree).encode("utf-8", "surrogatepass")).hexdigest()


def _shape(node: ast.AST) -> str:
    return " ".join((type(node).__name__, *_assigned_names(node)))


def _assigned_names(node: ast.AST) -> Iterator[str]:
    for name in _name_fields(type(node)):
        value = getattr(node, name)
        if isinstance(value, str):
            yield value
    if isinstance(node, ast.Global | ast.Nonlocal):
        yield from node.names


@cache
def _name_fields(kind: type[ast.AST]) -> tuple[str, ...]:
    known = ("name", "id", "attr", "arg", "asname", "module")
    return tuple(name for name in known if name in kind._fields)


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
                names |= {name for target in targets for name in _target_names(target)}
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr()):
                names.add(name)
            case ast.If():
                names |= _defined([*node.body, *node.orelse])
            case ast.Try():
                handled = [statement for handler in node.handlers for statement in handler.body]
                names |= _defined([*node.body, *node.orelse, *node.finalbody, *handled])
            case _:
                pass
    return names


def _target_names(target: ast.expr) -> list[str]:
    if isinstance(target, ast.Name):
        return [target.id]
    if isinstance(target, ast.Tuple | ast.List):
        return [name for element in target.elts for name in _target_names(element)]
    return []
