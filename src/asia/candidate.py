"""Candidate contract: what a `candidate.py` receives and returns, and the static checks of its
source.
"""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

import asia
from asia._syntax import syntax_tree
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import CandidateError, Reason
from asia.problem.physics import Physics
from asia.problem.symmetry import Symmetry

# Contract of a candidate: the context of a fit and the interface of a fitted model.


VALIDATION_SCORES = 200


def _no_log(step: float, loss: float) -> None:
    del step, loss


@dataclass(frozen=True)
class Context:
    """Everything that a candidate knows apart from its training trajectories."""

    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    sampling_time: float
    """Seconds."""
    n_past_u: int
    """Samples of the inputs in the past window."""
    n_past_y: int
    """Samples of the outputs in the past window."""
    horizon: int | None = None
    """Samples to simulate; None for the whole trajectory."""
    metric: str = "rmse"
    """Name of the metric that V is computed with."""
    physics: Physics | None = None
    """Equations from the problem file."""
    seed: int = 0
    """Seed for one search, fold and repeat, the same for every candidate."""
    deadline: float = float("inf")
    """Value of `time.monotonic()` after which the worker is killed."""
    threads: int = 1
    """Threads that a fit may use."""
    log: Callable[[float, float], None] = field(default=_no_log, compare=False)
    """log(step, loss): two numbers for the training curve."""
    validation_score: Callable[[Model], float] | None = field(default=None, compare=False)
    """validation_score(model): the fold's normalised metric of `model` on the held-out part, inf
    for a simulation that is not finite. There are VALIDATION_SCORES calls a fit, then it raises
    RuntimeError; its time counts as fit time. None unless the protocol's early_stopping is
    "validation", and None then too where nothing is held out: in the refit on all data."""
    symmetry: Symmetry = field(default_factory=dict[str, Mapping[str, str]])
    """Changes of the signals that leave the system's laws as they are, by name: for each signal
    that changes, the one that takes its place, with a minus where its sign changes."""

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)


class Model(Protocol):
    """A fitted model.

    It may also have `parameters() -> Mapping[str, float]`, by which the folds are compared: names
    of up to 48 characters and at most 64 finite numbers. It is asked for once, after the fit. And
    it may be a `StepModel` as well: then it is scored by its steps, one input sample at a time, and
    `asia export` prints it for other programs.
    """

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in open loop, in physical units.

        `u[:, k]` and `y_hat[:, k]` are the same sample; `past_*[:, -1]` is the one before. B and H
        are 1 or more, whatever the context's horizon. The result for a row depends on that row
        only, y_hat[:, k] on no later input, and neither on earlier calls.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Simulated outputs y_hat (B, H, ny).
        """
        ...


Fit = Callable[[Sequence[Trajectory], Context], Model]


# Estimates of a fitted model's parameters: standard errors, intervals and correlations.


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter with its uncertainty."""

    name: str
    """Name as in `parameters()`; at most 48 characters are kept."""
    value: float
    """Estimate in the parameter's unit."""
    standard_error: float
    """Standard error in the same unit; infinite where the records carry no information on it."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval."""
    unit: str = ""
    """Unit of the parameter; at most 16 characters are kept."""
    lower: float = float("-inf")
    """Least value that the fit searched; -inf for an open range."""
    upper: float = float("inf")
    """Greatest value that the fit searched; inf for an open range."""
    data_share: float = 1.0
    """Share of the information on the parameter that comes from the records, from 0 to 1; the rest
    comes from a prior or a ridge."""
    misfit_error: float = 0.0
    """Possible shift by a missing effect: half the width of an interval around the value; 0 where
    the residuals show no missing effect."""


@dataclass(frozen=True)
class ParameterEstimates:
    """Estimates of all parameters of a model, with their correlations."""

    parameters: tuple[ParameterEstimate, ...]
    """Estimates, one a parameter; at most 64 are kept."""
    correlation: Array
    """Correlations (n, n) of the errors; nan where one is not known."""
    equations: tuple[str, ...] = ()
    """The model's equations with the numbers put in, one a line; 8000 characters are kept."""


# Libraries that a candidate will import, read from its source and from the model library.


JAX = frozenset({"jax"})
_LOAD_JAX = ("jax", "equinox", "optax")


class _Imports(NamedTuple):
    """Names of imported modules, and of what is imported from them, which may be modules too."""

    first: frozenset[str] = frozenset()
    """Imports by statements that run when the module is imported."""
    later: frozenset[str] = frozenset()
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
    return any(name.split(".")[0] in ("equinox", "optax") for name in _reached(own, fitting=True))


def _reached(own: _Imports, *, fitting: bool) -> set[str]:
    """Modules that a source imports directly or through the library."""
    found, queue, seen = set(own.first), [*own.first], set[str]()
    while queue:
        name = queue.pop()
        if name in seen or not f"{name}.".startswith("asia.models."):
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
    return _Imports()


def _imports(source: str) -> _Imports:
    try:
        tree = syntax_tree(source, "candidate.py")
        first = frozenset(_names(tree.body, inside=False))
        return _Imports(first, frozenset(_names(tree.body, inside=True)) - first)
    except (SyntaxError, ValueError):
        return _Imports()


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


# Libraries that a candidate may import beside the standard one and `asia.models`.


def installed_libraries() -> tuple[str, ...]:
    """Names of these libraries that are installed here, as agents and users read them."""
    libraries = ("numpy", "scipy", "jax", "equinox", "optax")
    return tuple(name for name in libraries if find_spec(name) is not None)


# Limits on the data that a source carries. A candidate learns from its training records; one that
# contains numbers may have copied them from the answers.


MOST_LITERALS = 1024
MOST_NAMES = 2048
MOST_ALIKE = 1024
MOST_CODE = 7 * 1024


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
        CandidateError: as for `without_comments`.
    """
    docstrings = _docstrings(tree)
    literals: list[bytes] = []
    names: dict[str, None] = {}
    kinds: dict[frozenset[str], list[str]] = {}
    signs = ast.operator | ast.unaryop | ast.cmpop | ast.boolop
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node not in docstrings:
            value = node.value
            text = value if isinstance(value, str | bytes) else repr(value)
            literals.append(text if isinstance(text, bytes) else _encoded(text))
        names.update(dict.fromkeys(_assigned_names(node)))
        if isinstance(node, ast.stmt):
            parts = list(_parts(node))
            kind = frozenset(type(p).__name__ for p in parts if not isinstance(p, signs))
            kinds.setdefault(kind, []).extend(_shape(p) for p in parts)
    return SourceContent(
        _deflated(b"\n".join(literals)),
        _deflated(_encoded("\n".join(names))),
        max((_deflated(_encoded("\n".join(shapes))) for shapes in kinds.values()), default=0),
        _deflated(_encoded(without_comments(source, tree))),
    )


def without_comments(source: str, tree: ast.Module) -> str:
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


def _shape(node: ast.AST) -> str:
    return " ".join((type(node).__name__, *_assigned_names(node)))


def _assigned_names(node: ast.AST) -> Iterator[str]:
    for name in ("name", "id", "attr", "arg", "asname", "module"):
        value = getattr(node, name, None)
        if isinstance(value, str):
            yield value
    if isinstance(node, ast.Global | ast.Nonlocal):
        yield from node.names


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "replace")


def _deflated(data: bytes) -> int:
    return len(zlib.compress(data, 9, wbits=-zlib.MAX_WBITS))


# Check and identify the source of a candidate before anything of it runs.


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


def executed_source(source: str) -> str:
    """Source that a worker executes: without comments and docstrings, which could carry data.

    Lines keep their numbers.

    Raises:
        CandidateError: as for `check_source`.
    """
    return without_comments(source, _parse(source))


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
            match node.body:
                case [ast.Expr(value=ast.Constant(value=str())), *rest]:
                    node.body = rest
                case _:
                    pass
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
        return _parsed(source)
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


# State-space step contract of a fitted model, used for simulation and for `asia export`.


@runtime_checkable
class StepModel(Protocol):
    """Fitted model that simulates sample by sample, in physical units, for a batch of B cases.

    Both methods compute with NumPy arrays, and with JAX arrays where they are traced (`asia
    export`): they choose nothing by the values of signals. A state is any tree (tuples, lists,
    dicts) of arrays (B, ...) whose shapes stay the same; constants of float64 keep their precision.
    The result for a row depends on that row only.
    """

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State at the first sample, continued into the past by models that need it.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: input (B, nu) of the first sample.
        """
        ...

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        """Advance the state by one sample.

        Args:
            state: state at this sample.
            u: input (B, nu) of this sample.

        Returns:
            State at the next sample, and the output (B, ny) of this one.
        """
        ...


def simulate_steps(model: StepModel, past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate step by step: the `simulate` of a model that has no faster one.

    Args:
        model: fitted model.
        past_u: past inputs (B, n_past_u, nu).
        past_y: past outputs (B, n_past_y, ny).
        u: inputs (B, H, nu), H at least 1.

    Returns:
        Outputs (B, H, ny).
    """
    state, outputs = model.initial(past_u, past_y, u[:, 0]), list[Array]()
    for k in range(u.shape[1]):
        state, y = model.step(state, u[:, k])
        outputs.append(y)
    return np.stack(outputs, axis=1)
