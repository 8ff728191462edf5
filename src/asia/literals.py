"""Information in the literals of a source, in bits, and the same source with literals perturbed.

Both are pure functions of a syntax tree and its text. A candidate learns from its training records;
what its author wrote into it as data is counted here, on the safe side.
"""

from __future__ import annotations

import ast
import builtins
import copy
import random
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import isfinite, log2
from typing import TypeAlias

from asia._syntax import expression_tree

DIGIT = log2(10.0)
"""Bits of a significant digit."""
RUN = 8
"""Siblings of one kind from which on their order counts as data."""

# Names that reach the text, the names or the layout of a program: then all of them count.
_REFLECTIVE = re.compile(
    r"inspect|linecache|traceback|tokenize|symtable|dis|ast|gc|ctypes|sys|importlib|pkgutil|marshal"
    r"|getsource\w*|_getframe|currentframe|f_\w+|tb_\w+|co_\w+|gi_\w+|settrace|setprofile"
    r"|open|open_code|FileIO|mmap|fileinput|read_text|read_bytes|fromfile|genfromtxt|loadtxt|memmap|vars|dir|locals|globals|eval"
    r"|exec|compile|__import__|__(?:file|loader|spec|code|dict|name|qualname|doc|annotations|slots"
    r"|kwdefaults|defaults|closure|globals|builtins|subclasses|mro|traceback|getattr|getattribute"
    r"|set_name|prepare|class_getitem|dataclass_fields|match_args|members|static_attributes"
    r"|firstlineno)__|_fields|_asdict|_member_names_|get_type_hints|NameError|AttributeError"
    r"|UnboundLocalError"
)


Link: TypeAlias = tuple[str, float]
"""One sibling of a run as text, and its bits."""


@dataclass(frozen=True)
class Literals:
    """Data in a source, by item."""

    numbers: Mapping[str, int]
    """Uses of each number outside of runs."""
    strings: frozenset[str]
    runs: tuple[tuple[Link, ...], ...]
    """Runs of siblings of one kind: tables of numbers, truth values or names."""
    text: str = ""
    """The whole text, where the program can read it; "" where not."""
    reader: str = ""
    """Name in the source by which the program can read its text, or `**kwargs`."""

    def bits_beyond(self, *known: Literals) -> float:
        """Bits that are not in any of the `known` sources.

        A number counts as known as often as the known source with most uses has it. A string or a
        link of a run counts as known if it stands before or behind the first and the last change of
        a run of one of them. The whole text counts as new if it differs.
        """
        numbers = sum(
            max(uses - max((k.numbers.get(text, 0) for k in known), default=0), 0)
            * number_bits(text)
            for text, uses in self.numbers.items()
        )
        known_runs = [run for k in known for run in k.runs]
        runs = sum(min(_changed(run, one) for one in ((), *known_runs)) for run in self.runs)
        strings = self.strings.difference(*(k.strings for k in known))
        total = numbers + _deflated_bits("\n".join(sorted(strings))) + runs
        if self.text and all(self.text != k.text for k in known):
            total += _deflated_bits(self.text)
        return total


def _changed(run: Sequence[Link], known: Sequence[Link]) -> float:
    """Bits of the links between the first and the last change."""
    shorter = min(len(run), len(known))
    start = next((i for i in range(shorter) if run[i][0] != known[i][0]), shorter)
    most = shorter - start
    end = next((i for i in range(most) if run[-1 - i][0] != known[-1 - i][0]), most)
    return sum(bits for _, bits in run[start : len(run) - end])


NOTHING = Literals({}, frozenset(), ())


def number_bits(text: str) -> float:
    """Bits of a number: its significant digits as written, trailing zeros behind a point included,
    and its exponent.

    Args:
        text: the number as the source has it.
    """
    plain = text.lower().replace("_", "")
    if plain in ("true", "false", "none", "..."):
        return 1.0
    if plain.startswith("0x"):
        return 4.0 * len(plain[2:])
    if plain.startswith("0o"):
        return 3.0 * len(plain[2:])
    if plain.startswith("0b"):
        return float(len(plain[2:]))
    mantissa, _, exponent = plain.rstrip("j").partition("e")
    whole, point, behind = mantissa.partition(".")
    digits = (whole + behind).lstrip("0")
    if not point:
        # The zeros behind a whole number say how large it is.
        digits, ended = digits.rstrip("0"), len(digits)
        size = log2(1 + ended - len(digits)) + len(exponent) * DIGIT
        return max(len(digits), 1) * DIGIT + size
    places = len(behind) - len(behind.lstrip("0")) if not whole.strip("0") else len(whole)
    return max(len(digits), 1) * DIGIT + log2(1 + places) + len(exponent) * DIGIT


def literals(text: str, tree: ast.Module) -> Literals:
    """Return the data in a source.

    Comments and docstrings are left out: a worker gets a source without them. Names and layout
    count only where the program reaches them (`inspect`, `__dict__`, frames, ...), and then with
    the whole text.

    Args:
        text: the source without comments and docstrings.
        tree: the same source, parsed.
    """
    lines = text.encode().splitlines(keepends=True)
    numbers: Counter[str] = Counter()
    strings: set[str] = set()
    runs: list[tuple[Link, ...]] = []
    in_runs: set[int] = set()
    for siblings in _runs(tree):
        shapes = [_shape(node) for node in siblings]
        choice = log2(len(set(shapes)))
        links: list[Link] = []
        for nodes, shape in zip(siblings, shapes, strict=True):
            inner = [c for n in nodes for c in ast.walk(n) if isinstance(c, ast.Constant)]
            own = [_written(c, lines) for c in inner if _is_number(c) and id(c) not in in_runs]
            in_runs |= {id(c) for c in inner}
            links.append((" ".join([shape, *own]), choice + sum(map(number_bits, own))))
        runs.append(tuple(links))
    docstrings = _blanked(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or id(node) in docstrings:
            continue
        if not _is_number(node):
            value = node.value
            strings.add(value if isinstance(value, str) else repr(value))
        elif id(node) not in in_runs:
            numbers[_written(node, lines)] += 1
    reader = _reader(tree)
    seen = text if reader else ""
    return Literals(dict(numbers), frozenset(strings), tuple(runs), seen, reader)


# Sources that only declare equations and call the model library.


_DECLARED: Mapping[str, frozenset[str]] = {
    "__future__": frozenset({"annotations"}),
    "dataclasses": frozenset({"replace"}),
    "asia.models": frozenset({"greybox"}),
    "asia.models.greybox": frozenset({"Bounds", "ParameterRange", "Physics", "Prior"}),
    "asia.models.methods": frozenset({"LevenbergMarquardt"}),
}
_FAMILY = frozenset({"Config", "build", "train"})
_ARGUMENTS: Mapping[str, tuple[str, ...]] = {
    "build_model": ("context",),
    "train": ("model", "trajectories", "context"),
    "fit": ("trajectories", "context"),
}


def equations_as_code(tree: ast.Module) -> ast.Module:
    """Return the source with the texts of its equations in the place of strings, where it does
    nothing else than declare them and call the model library; else the same tree.

    Such a program computes nothing, so it cannot read its strings. Their names and layout count as
    little as those of code, their numbers and runs as much.

    Args:
        tree: the source without comments and docstrings, parsed; it is not changed.
    """
    if not all(map(_is_declaration, tree.body)):
        return tree
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "Physics":
            for inner in ast.walk(node):
                if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                    found = _equation(inner.value)
                    if isinstance(found, ast.Name):
                        names.add(found.id)
    return ast.fix_missing_locations(_Equations(names).visit(copy.deepcopy(tree)))


class _Equations(ast.NodeTransformer):
    """Puts parsed texts in the place of strings: all inside `Physics(...)`, elsewhere names."""

    def __init__(self, names: set[str]) -> None:
        self._names, self._inside = names, False

    def visit_Call(self, node: ast.Call) -> ast.AST:
        outer, self._inside = self._inside, self._inside or ast.unparse(node.func) == "Physics"
        self.generic_visit(node)
        self._inside = outer
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if not isinstance(node.value, str) or not (self._inside or node.value in self._names):
            return node
        return _equation(node.value) or node


def _equation(text: str) -> ast.expr | None:
    """The parsed text of an equation; None for any other."""
    try:
        found = expression_tree(text).body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    kinds = (
        ast.Name, ast.BinOp, ast.UnaryOp, ast.Call, ast.Constant, ast.operator, ast.unaryop,
        ast.expr_context,
    )  # fmt: skip
    for node in ast.walk(found):
        match node:
            case ast.Constant(value=int() | float()) | ast.Call(func=ast.Name(), keywords=[]):
                pass
            case ast.Constant() | ast.Call():
                return None
            case _ if not isinstance(node, kinds):
                return None
            case _:
                pass
    return found


def _is_declaration(node: ast.stmt) -> bool:
    """Whether a statement imports from the model library, declares values, or is one of the
    functions of a candidate that does."""
    match node:
        case ast.Expr(value=ast.Constant(value="")):
            return True
        case ast.ImportFrom(module=str(module), names=names, level=0):
            known = _DECLARED.get(module, frozenset())
            return all(one.asname is None and one.name in known for one in names)
        case ast.Assign(targets=[ast.Name(id=name)], value=value):
            return name not in _ARGUMENTS and name not in _CALLED and _is_value(value)
        case ast.FunctionDef(name=name, decorator_list=[], returns=None, args=arguments, body=body):
            *before, last = body
            own = ast.unparse(arguments) == ", ".join(_ARGUMENTS.get(name, ("*",)))
            plain = all(isinstance(n, ast.Assign | ast.Expr) and _is_declaration(n) for n in before)
            returned = last.value if isinstance(last, ast.Return) else None
            return own and plain and returned is not None and _is_value(returned)
        case _:
            return False


_CALLED = frozenset().union(*_DECLARED.values())


def _is_value(node: ast.expr) -> bool:
    match node:
        case ast.Constant() | ast.UnaryOp(op=ast.USub(), operand=ast.Constant()):
            return True
        case ast.Name(id=name):
            return name not in dir(builtins)
        case ast.Call(func=ast.Name(id="replace"), args=args, keywords=keywords):
            named = [ast.unparse(one) for one in args] + [str(one.arg) for one in keywords]
            return named == ["context", "physics"] and _is_value(keywords[0].value)
        case ast.Tuple(elts=elts):
            return all(map(_is_value, elts))
        case ast.Dict(keys=keys, values=values):
            return all(isinstance(k, ast.Constant) for k in keys) and all(map(_is_value, values))
        case ast.Call(func=func, args=args, keywords=keywords):
            match func:
                case ast.Attribute(value=ast.Name(id="greybox"), attr=attr):
                    known = attr in _FAMILY
                case ast.Name(id=name):
                    known = name in _ARGUMENTS or name in _CALLED
                case _:
                    known = False
            named = all(keyword.arg is not None for keyword in keywords)
            return known and named and all(map(_is_value, (*args, *(k.value for k in keywords))))
        case _:
            return False


def merged(parts: Iterable[Literals]) -> Literals:
    """Literals known from any of several sources: each number once, which is a word of a language
    and no table."""
    numbers: dict[str, int] = {}
    strings: set[str] = set()
    for part in parts:
        numbers |= dict.fromkeys(part.numbers, 1)
        strings |= part.strings
    return Literals(numbers, frozenset(strings), ())


def perturbed(tree: ast.Module, known: Literals, seed: int, *, strings: bool = True) -> str | None:
    """Return the source with its new literals moved a little, at random; None where none can be.

    Numbers move by one in their last significant digit if they have two digits or more (whole
    numbers outside of runs: three). A number of one digit is a choice, such as a power, an index or
    an order: moving it makes another program. In tables of 32 entries and more all numbers move,
    and a quarter of the truth values, names and signs of a sum are exchanged. In strings of 32
    characters and more, each letter and digit moves to the next or the one before. The layout is
    not that of the given source.

    Args:
        tree: the source without comments and docstrings, parsed; it is changed.
        known: literals that stay.
        seed: for the directions, unknown to the author.
        strings: false to leave strings as they are.
    """
    rng = random.Random(seed)
    runs = list(_runs(tree))
    in_runs = {id(n) for s in runs for one in s for top in one for n in ast.walk(top)}
    tables = [s for s in runs if len(s) >= _TABLE]
    in_tables = {id(n) for s in tables for one in s for top in one for n in ast.walk(top)}
    uses: Counter[str] = Counter()
    moved = 0
    for node in ast.walk(tree):
        match node:
            case ast.Constant(value=bool(value)):
                if id(node) in in_tables and rng.random() < _EXCHANGED:
                    node.value, moved = not value, moved + 1
            case ast.Constant(value=int() | float() as value):
                written = repr(value)
                uses[written] += 1
                digits = len(re.sub(r"e.*|[^0-9]", "", written).strip("0"))
                least = 2 if isinstance(value, float) or id(node) in in_runs else 3
                if id(node) not in in_runs and uses[written] <= known.numbers.get(written, 0):
                    continue
                if digits >= least or (id(node) in in_tables and value):
                    node.value, moved = _moved(value, rng.choice((-1, 1))), moved + 1
            case ast.Constant(value=str(value)) if strings and len(value) >= _TABLE:
                if value not in known.strings:
                    node.value, moved = _shifted(value, rng), moved + 1
            case ast.Constant(value=bytes(value)) if strings and len(value) >= _TABLE:
                if repr(value) not in known.strings:
                    shifted = _shifted(value.decode("latin-1"), rng).encode("latin-1")
                    node.value, moved = shifted, moved + 1
            case ast.BinOp(op=ast.Add() | ast.Sub()) if id(node.op) in in_tables:
                if rng.random() < _EXCHANGED:
                    node.op = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
                    moved += 1
            case _:
                pass
    for siblings in tables:
        names = [n for one in siblings for top in one for n in _names_of(top)]
        chosen = sorted({n.id for n in names})
        for name in names if len(chosen) > 1 else ():
            if isinstance(name.ctx, ast.Load) and rng.random() < _EXCHANGED:
                name.id, moved = rng.choice(chosen), moved + 1
    return ast.unparse(tree) if moved else None


_TABLE = 32
"""Entries from which on a run is a table, and characters of a string that may be one."""
_EXCHANGED = 0.25


def _names_of(node: ast.AST) -> list[ast.Name]:
    """The name that a link consists of."""
    return [node] if isinstance(node, ast.Name) else []


def _shifted(text: str, rng: random.Random) -> str:
    """The text with each letter and digit moved by one place in its alphabet."""

    def moved(letter: str) -> str:
        for first, last in ("09", "az", "AZ"):
            if first <= letter <= last:
                size = ord(last) - ord(first) + 1
                return chr(ord(first) + (ord(letter) - ord(first) + rng.choice((-1, 1))) % size)
        return letter

    return "".join(map(moved, text))


def _moved(value: float, direction: int) -> float:
    """The number with its last significant digit moved by one; up where it would become zero."""
    if isinstance(value, int):
        step = 1
        while value and value % (step * 10) == 0:
            step *= 10
        return value + direction * step if abs(value) > step else value + step
    if value == 0.0 or not isfinite(value):
        return value
    digits, exponent = Decimal(repr(value)).normalize().as_tuple()[1:]
    unscaled = int("".join(map(str, digits)))
    return float(Decimal(unscaled + (direction if unscaled > 1 else 1)).scaleb(int(exponent)))


def _is_number(node: ast.Constant) -> bool:
    return not isinstance(node.value, str | bytes)


def _written(node: ast.Constant, lines: list[bytes]) -> str:
    """The number as the source has it: `1.50` carries more than `1.5`."""
    part = lines[node.lineno - 1][node.col_offset : node.end_col_offset]
    try:
        found = part.decode()
    except UnicodeDecodeError:
        found = ""
    # Inside an f-string the position is that of the string.
    return found if re.fullmatch(r"[\w.+-]+", found) else repr(node.value)


def _blanked(tree: ast.Module) -> set[int]:
    """Empty strings that stand alone, in the place of docstrings."""
    return {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if node.value.value == ""
    }


def _reader(tree: ast.Module) -> str:
    """Return the name by which the program can read its own text or names; "" for none."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                found = [part for one in names for part in one.name.split(".")]
            case ast.ImportFrom(module=module, names=names):
                found = [*(module or "").split("."), *(one.name for one in names)]
            case ast.Call(func=ast.Name(id="getattr" | "setattr" | "hasattr" as word), args=args):
                match args:
                    case [_, ast.Constant(value=str(name)), *_]:
                        found = [name]
                    case _:
                        return word
            case ast.Name(id=name) | ast.Attribute(attr=name):
                found = [name]
            case ast.Call(func=ast.Name(id="dict"), keywords=keywords) if len(keywords) >= RUN:
                return "dict"
            case (
                ast.FunctionDef(args=ast.arguments(kwarg=ast.arg()))
                | ast.Lambda(args=ast.arguments(kwarg=ast.arg()))
            ):
                return "**kwargs"
            case _:
                continue
        if known := [name for name in found if _REFLECTIVE.fullmatch(name)]:
            return known[0]
    return ""


# Runs: siblings of one kind whose choice or order can spell data.


def _runs(tree: ast.Module) -> Iterator[list[list[ast.AST]]]:
    """Siblings of one kind, each as a list of nodes, outermost first: elements of a display, the
    arguments of a call, links of a chain of operators, and statements of the same parts."""
    statements: dict[str, list[list[ast.AST]]] = {}
    linked: set[int] = set()
    for node in ast.walk(tree):
        siblings: list[list[ast.AST]] = []
        match node:
            case ast.Tuple(elts=elts) | ast.List(elts=elts) | ast.Set(elts=elts):
                siblings = [[one] for one in elts]
            case ast.Dict(keys=keys, values=values):
                siblings = [
                    [*([key] if key else []), value]
                    for key, value in zip(keys, values, strict=True)
                ]
            case ast.Call(args=args, keywords=keywords) if len(args) + len(keywords) >= RUN:
                siblings = [[one] for one in (*args, *keywords)]
            case ast.BoolOp(values=values):
                siblings = [[one] for one in values]
            case ast.Compare(ops=ops, comparators=others):
                siblings = [[op, one] for op, one in zip(ops, others, strict=True)]
            case ast.stmt():
                if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Import):
                    parts = list(_own_parts(node))
                    kind = " ".join(sorted({type(p).__name__ for p in parts}))
                    statements.setdefault(kind, []).append(
                        [n for n in ast.iter_child_nodes(node) if not isinstance(n, ast.stmt)]
                    )
            case _:
                pass
        if len(siblings) >= RUN:
            yield siblings
        if isinstance(node, ast.expr) and id(node) not in linked:
            chain = list(_chain(node, linked))
            if len(chain) >= RUN:
                yield chain
    yield from (group for group in statements.values() if len(group) >= RUN)


def _own_parts(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of a statement without those of statements inside it."""
    left: list[ast.AST] = [statement]
    while left:
        node = left.pop()
        yield node
        left += [c for c in ast.iter_child_nodes(node) if not isinstance(c, ast.stmt)]


def _chain(node: ast.expr, linked: set[int]) -> Iterator[list[ast.AST]]:
    """Links of a chain: `a + b - c`, `-+-a`, `f(g(f(x)))`, `a if b else c if d else e`."""
    while True:
        linked.add(id(node))
        match node:
            case ast.BinOp(left=below, op=op, right=right):
                yield [op, right]
            case ast.UnaryOp(op=op, operand=below):
                yield [op]
            case ast.Call(func=func, args=[below]):
                yield [func]
            case ast.IfExp(test=test, body=body, orelse=below):
                yield [test, body]
            case _:
                return
        node = below


def _shape(nodes: list[ast.AST]) -> str:
    """Text of nodes in which numbers count as one another."""
    return " ".join(
        "number" if isinstance(n, ast.Constant) and _is_number(n) else _label(n)
        for top in nodes
        for n in ast.walk(top)
        if not isinstance(n, ast.expr_context)
    )


def _label(node: ast.AST) -> str:
    names = (getattr(node, name, None) for name in ("id", "attr", "arg", "name"))
    return " ".join([type(node).__name__, *(name for name in names if isinstance(name, str))])


def _deflated_bits(text: str) -> float:
    if not text:
        return 0.0
    data = text.encode("utf-8", "replace")
    return 8.0 * len(zlib.compress(data, 9, wbits=-zlib.MAX_WBITS))
