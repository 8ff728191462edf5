"""Information in the literals of a source, in bits, and the same source with literals perturbed.

Both are pure functions of a syntax tree and its text. A candidate learns from its training records;
what its author wrote into it as data is counted here, on the safe side.
"""

from __future__ import annotations

import ast
import random
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import log2
from typing import TypeAlias

DIGIT = log2(10.0)
"""Bits of a significant digit."""
RUN = 8
"""Siblings of one kind from which on their order counts as data."""

# Names that reach the text, the names or the layout of a program: then all of them count.
_REFLECTIVE = re.compile(
    r"inspect|linecache|traceback|tokenize|symtable|dis|ast|gc|ctypes|sys|importlib|pkgutil|marshal"
    r"|getsource\w*|_getframe|currentframe|f_\w+|tb_\w+|co_\w+|gi_\w+|settrace|setprofile"
    r"|open|read_text|read_bytes|fromfile|genfromtxt|loadtxt|memmap|vars|dir|locals|globals|eval"
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
        strings = self.strings.difference(*(k.strings for k in known))
        known_runs = [run for k in known for run in k.runs]
        runs = sum(min((_changed(run, one) for one in ((), *known_runs))) for run in self.runs)
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
        return max(len(digits), 1) * DIGIT + log2(1 + ended - len(digits))
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
    return Literals(dict(numbers), frozenset(strings), tuple(runs), text if _is_reflective(tree) else "")


def merged(parts: Iterable[Literals]) -> Literals:
    """Literals known from any of several sources: each number once, which is a word of a language
    and no table."""
    numbers: dict[str, int] = {}
    strings: set[str] = set()
    for part in parts:
        numbers |= dict.fromkeys(part.numbers, 1)
        strings |= part.strings
    return Literals(numbers, frozenset(strings), ())


def perturbed(text: str, tree: ast.Module, known: Literals, seed: int) -> str | None:
    """Return the source with its new numbers moved by one in their last significant digit, up or
    down at random; None where it has no such number.

    Numbers in runs move whatever their length. Other numbers move if they have two significant
    digits or more: one digit is a choice (a power, an index, an order), and moving it makes another
    program.

    Args:
        text: the source without comments and docstrings.
        tree: the same source, parsed.
        known: literals that stay.
        seed: for the directions, unknown to the author.
    """
    rng = random.Random(seed)
    lines = text.encode().splitlines(keepends=True)
    moved: list[tuple[int, int, int, bytes]] = []
    in_runs = {id(n) for s in _runs(tree) for one in s for top in one for n in ast.walk(top)}
    seen: Counter[str] = Counter()
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not _is_number(node):
            continue
        value, written = node.value, _written(node, lines)
        seen[written] += 1
        if isinstance(value, bool | None | type(...)):
            if id(node) in in_runs and isinstance(value, bool) and rng.random() < 0.25:
                moved.append(_edit(node, str(not value)))
            continue
        digits = len(re.sub(r"e.*|[^0-9]", "", written.lower()).strip("0"))
        if id(node) not in in_runs:
            if seen[written] <= known.numbers.get(written, 0):
                continue
            if digits < 2 or (isinstance(value, int) and digits < 3):
                continue
        moved.append(_edit(node, _moved(written, value, rng.choice((-1, 1)))))
    if not moved:
        return None
    for row, start, stop, new in sorted(moved, reverse=True):
        lines[row] = lines[row][:start] + new + lines[row][stop:]
    return b"".join(lines).decode()


def _edit(node: ast.Constant, new: str) -> tuple[int, int, int, bytes]:
    assert node.end_col_offset is not None
    return node.lineno - 1, node.col_offset, node.end_col_offset, new.encode()


def _moved(written: str, value: complex, direction: int) -> str:
    """The number with its last significant digit moved by one; a number that would become negative
    or zero moves up."""
    if isinstance(value, int):
        step = 1
        while value and value % (step * 10) == 0:
            step *= 10
        found = value + direction * step
        return str(found if found > 0 else value + step)
    plain = written.lower().replace("_", "")
    mantissa, e, exponent = plain.rstrip("j").partition("e")
    whole, _, behind = mantissa.partition(".")
    behind = behind.rstrip("0")
    unscaled = int((whole + behind) or "0")
    step = 1
    while not behind and unscaled and unscaled % (step * 10) == 0:
        step *= 10
    found = unscaled + direction * step
    found = found if found > 0 else unscaled + step
    digits = str(found).rjust(len(behind) + 1, "0")
    cut = len(digits) - len(behind)
    return f"{digits[:cut]}.{digits[cut:]}{e}{exponent}{'j' if plain.endswith('j') else ''}"


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


def _is_reflective(tree: ast.Module) -> bool:
    """Return whether the program can read its own text or its names."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                found = [part for one in names for part in one.name.split(".")]
            case ast.ImportFrom(module=module, names=names):
                found = [*(module or "").split("."), *(one.name for one in names)]
            case ast.Call(func=ast.Name(id="getattr" | "setattr" | "hasattr"), args=args):
                match args:
                    case [_, ast.Constant(value=str(name)), *_]:
                        found = [name]
                    case _:
                        return True
            case ast.Name(id=name) | ast.Attribute(attr=name):
                found = [name]
            case ast.Call(func=ast.Name(id="dict"), keywords=keywords) if len(keywords) >= RUN:
                return True
            case ast.FunctionDef(args=ast.arguments(kwarg=ast.arg())) | ast.Lambda(
                args=ast.arguments(kwarg=ast.arg())
            ):
                return True
            case _:
                continue
        if any(_REFLECTIVE.fullmatch(name) for name in found):
            return True
    return False


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
