"""Rigorous evaluation of lowered programs over sets: affine forms with outward rounding.

A value is enclosed by c + sum_i g_i e_i + r e with all |e| <= 1: centre c, generators g that values
share, and a radius r of its own. Every operation encloses the exact result and the one in double
precision, provided that a library function errs by less than 8 units in the last place. Source:
Stolfi and de Figueiredo, Self-Validated Numerical Methods, 1997.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.lowering.evaluation import evaluate
from asia.lowering.program import Attributes, LoweredModel, Node, Program

_EPS = 2.0**-52
_PIECES = 32
_GENERATORS = 200
_MOVES = frozenset(["reshape", "broadcast", "transpose", "slice", "pick", "concat", "pad"])


class UnboundedError(ArithmeticError):
    """Operation without a finite enclosure, such as a division by an interval that holds 0."""


def _up(x: Array) -> Array:
    """Upper bound of a sum of few thousand positive numbers that was computed in any order."""
    return x * (1.0 + 1e-12) + 1e-300


@dataclass(frozen=True)
class Enclosure:
    """Set of arrays."""

    c: Array
    """Centre, of the shape of the value."""
    g: Array
    """Generators, one more axis in front."""
    r: Array
    """Radius of its own."""

    @property
    def radius(self) -> Array:
        """Largest distance from the centre."""
        return _up(np.abs(self.g).sum(axis=0) + self.r)

    @property
    def low(self) -> Array:
        """Lower bound."""
        return np.nextafter(self.c - self.radius, -np.inf)

    @property
    def high(self) -> Array:
        """Upper bound."""
        return np.nextafter(self.c + self.radius, np.inf)

    @property
    def size(self) -> Array:
        """Largest absolute value."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    def __add__(self, other: Enclosure) -> Enclosure:
        return _rounded(self.c + other.c, self.g + other.g, self.r + other.r)

    def __neg__(self) -> Enclosure:
        return Enclosure(-self.c, -self.g, self.r)

    def __sub__(self, other: Enclosure) -> Enclosure:
        return self + -other

    def __mul__(self, other: Enclosure) -> Enclosure:
        a, b = self, other
        g = b.g * a.c + a.g * b.c
        if a is b:
            square = 0.5 * a.radius**2
            return _rounded(a.c**2 + square, g, 2.0 * np.abs(a.c) * a.r + square, np.abs(g).sum(0))
        rest = np.abs(a.c) * b.r + np.abs(b.c) * a.r + a.radius * b.radius
        return _rounded(a.c * b.c, g, rest, np.abs(a.c) * b.radius + np.abs(b.c) * a.radius)

    def __matmul__(self, other: Enclosure) -> Enclosure:
        a, b = self, other
        g = a.g @ b.c + a.c @ b.g
        rest = np.abs(a.c) @ b.r + a.r @ np.abs(b.c) + a.radius @ b.radius
        lost = (2 + a.c.shape[-1]) * (a.size @ b.size)
        return _rounded(a.c @ b.c, g, rest, lost)

    @property
    def transposed(self) -> Enclosure:
        """Transpose of a matrix."""
        return Enclosure(self.c.T, self.g.swapaxes(1, 2), self.r.T)


def _rounded(c: Array, g: Array, r: Array, lost: Array | float = 0.0) -> Enclosure:
    """Enclosure with the rounding errors of c, g and a computation of size `lost`."""
    size = np.abs(c) + np.abs(g).sum(axis=0) + r + lost
    found = Enclosure(c, g, _up(r + 4.0 * _EPS * size))
    if not np.isfinite(found.r).all() or not np.isfinite(c).all():
        raise UnboundedError("the enclosure is not finite")
    return found


def point(values: object, generators: int = 0) -> Enclosure:
    """Enclosure of one array."""
    c = np.asarray(values, np.float64)
    return Enclosure(c, np.zeros((generators, *c.shape)), np.zeros(c.shape))


def interval(low: Array, high: Array, generators: int = 0) -> Enclosure:
    """Enclosure of all arrays between two."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    c = 0.5 * low + 0.5 * high
    radius = _up(np.maximum(high - c, c - low)) * (1.0 + 4.0 * _EPS) + 4.0 * _EPS * np.abs(c)
    exact = (low == high) & (c == low)
    return Enclosure(c, np.zeros((generators, *c.shape)), np.where(exact, 0.0, radius))


def _hull(low: Array, high: Array, like: Enclosure) -> Enclosure:
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise UnboundedError("the enclosure is not finite")
    low, high = (x + s * 8 * _EPS * np.abs(x) for x, s in ((low, -1), (high, 1)))
    return interval(low, high, len(like.g))


def _where(mask: NDArray[np.bool_], a: Enclosure, b: Enclosure) -> Enclosure:
    return Enclosure(np.where(mask, a.c, b.c), np.where(mask, a.g, b.g), np.where(mask, a.r, b.r))


# Functions of one array: value, derivative. The derivative is largest and smallest at the ends of
# an interval, or at 0 inside of it.

_Function = Callable[[Array], Array]
_MULTIQUADRIC = "sqrt(1 + x^2)"
_SMOOTH: dict[str, tuple[_Function, _Function]] = {
    "reciprocal": (lambda x: 1.0 / x, lambda x: -1.0 / x**2),
    "abs": (np.abs, np.sign),
    "sqrt": (np.sqrt, lambda x: 0.5 / np.sqrt(x)),
    "exp": (np.exp, np.exp),
    "expm1": (np.expm1, np.exp),
    "log": (np.log, lambda x: 1.0 / x),
    "log1p": (np.log1p, lambda x: 1.0 / (1.0 + x)),
    "tanh": (np.tanh, lambda x: 1.0 - np.tanh(x) ** 2),
    "sin": (np.sin, np.cos),
    "cos": (np.cos, lambda x: -np.sin(x)),
    "tan": (np.tan, lambda x: 1.0 + np.tan(x) ** 2),
    "asin": (np.arcsin, lambda x: 1.0 / np.sqrt(1.0 - x**2)),
    "acos": (np.arccos, lambda x: -1.0 / np.sqrt(1.0 - x**2)),
    "atan": (np.arctan, lambda x: 1.0 / (1.0 + x**2)),
    "sinh": (np.sinh, np.cosh),
    "cosh": (np.cosh, np.sinh),
    _MULTIQUADRIC: (lambda x: np.sqrt(1.0 + x**2), lambda x: x / np.sqrt(1.0 + x**2)),
}
# Where these hold: least and largest argument.
_DOMAIN = {"log": (0.0, math.inf), "log1p": (-1.0, math.inf), "tan": (-1.5, 1.5)}
_CLOSED = {"sqrt": (0.0, math.inf), "asin": (-1.0, 1.0), "acos": (-1.0, 1.0)}
_TURNING = {"sin": 3.1, "cos": 1.5}


def _smooth(name: str, x: Enclosure, *, chord: bool) -> Enclosure:
    """alpha x + beta with a bound of the error over pieces of the interval. alpha is the mean of
    the slopes, which keeps limits of monotone steps, or that of the chord, which errs least."""
    function, slope = _SMOOTH[name]
    low, high = x.low, x.high
    if name in _CLOSED:
        # What max(x, 0) encloses lies beyond the edge by the rounding of centre and radius alone.
        edge = _CLOSED[name]
        if (x.c < edge[0]).any() or (x.c > edge[1]).any():
            raise UnboundedError(f"{name} of a number outside its domain")
        if ((low < edge[0]) | (high > edge[1])).any():
            beyond = np.maximum(edge[0] - low, high - edge[1])
            if (beyond > 4e-12 * (1e-6 + x.size)).any():
                raise UnboundedError(f"{name} of an interval outside its domain")
            low, high = np.maximum(low, edge[0]), np.minimum(high, edge[1])
    least, most = _DOMAIN.get(name, (-math.inf, math.inf))
    if (low <= least).any() or (high >= most).any():
        raise UnboundedError(f"{name} of an interval outside its domain")
    if name == "reciprocal" and ((low <= 0) & (high >= 0)).any():
        raise UnboundedError("division by an interval that holds 0")
    edges = low + (high - low) * np.linspace(0.0, 1.0, _PIECES + 1).reshape(-1, *[1] * low.ndim)
    edges[-1] = high
    ends = np.stack([low, high, np.clip(0.0, low, high)])
    with np.errstate(all="ignore"):
        slopes = slope(ends)
        alpha = 0.5 * (slopes.min(axis=0) + slopes.max(axis=0))
        alpha = (function(high) - function(low)) / (high - low) if chord else alpha
        alpha = np.where(np.isfinite(alpha), alpha, 0.0)
        left, right = edges[:-1], edges[1:]
        steep = slope(np.stack([left, right, np.clip(0.0, left, right)]))
        bounds = [steep.min(axis=0), steep.max(axis=0)]
        if name in _TURNING:
            wide = np.maximum(np.abs(left), np.abs(right)) > _TURNING[name]
            bounds = [np.where(wide, -1.0, bounds[0]), np.where(wide, 1.0, bounds[1])]
        middle = 0.5 * (left + right)
        half = 0.5 * (right - left) + 2.0 * _EPS * (np.abs(left) + np.abs(right))
        values = function(middle)
        off = half * (1 + 1e-12) * (np.maximum(np.abs(bounds[0] - alpha), np.abs(bounds[1] - alpha))
                                    * (1 + 1e-12) + 16 * _EPS * (1.0 + np.abs(alpha)))  # fmt: skip
        rest = values - alpha * middle
        smallest, largest = (rest - off).min(axis=0), (rest + off).max(axis=0)
        if name == "sqrt":
            # Infinite slope at 0: rising, so that its ends bound it.
            flat = ~np.isfinite(smallest + largest)
            alpha = np.where(flat, 0.0, alpha)
            smallest = np.where(flat, function(low), smallest)
            largest = np.where(flat, function(high), largest)
    shift = point(0.5 * (smallest + largest), len(x.g))
    lost = 8.0 * (np.abs(values).max(axis=0) + np.abs(alpha) * x.size)
    error = 0.5 * (largest - smallest) * (1 + 1e-12) + 4 * _EPS * lost
    return x * point(alpha, len(x.g)) + Enclosure(shift.c, shift.g, error)


def _power(base: Enclosure, exponent: Enclosure, *, chord: bool) -> Enclosure:
    p = exponent.c.reshape(-1)
    known = not exponent.radius.any() or float(exponent.radius.max()) <= 2e-300
    if known and len(p) and (p == p[0]).all() and p[0] == round(p[0]) and 0 <= p[0] <= 64:
        found = point(np.ones(base.c.shape), len(base.g))
        for bit in bin(int(p[0]))[2:]:
            found = found * found
            found = found * base if bit == "1" else found
        return found
    return _smooth("exp", exponent * _smooth("log", base, chord=chord), chord=chord)


def _compare(op: str, a: Enclosure, b: Enclosure) -> Enclosure:
    """1 where it certainly holds, 0 where it certainly does not, else the interval of both."""
    if op in ("gt", "ge"):
        a, b, op = b, a, {"gt": "lt", "ge": "le"}[op]
    if op in ("eq", "ne"):
        apart = (a.low > b.high) | (a.high < b.low)
        exact = (a.low >= b.high) & (a.high <= b.low)
        yes, no = (exact, apart) if op == "eq" else (apart, exact)
    else:
        yes, no = (a.high < b.low, a.low >= b.high) if op == "lt" else (
            a.high <= b.low, a.low > b.high)  # fmt: skip
    return interval(yes.astype(float), (~no).astype(float), len(a.g))


def _apply(
    op: str, attrs: Attributes, x: list[Enclosure], shape: tuple[int, ...], *, chord: bool
) -> Enclosure:
    if op in _MOVES:
        starts = np.cumsum([0, *(one.c.size for one in x)])
        places = [
            s + np.arange(one.c.size).reshape(one.c.shape)
            for s, one in zip(starts[:-1], x, strict=True)
        ]
        (found,) = _moved(op, attrs, [p.astype(np.float64) for p in places], shape)
        order = found.astype(int).reshape(-1)
        flat = [
            np.concatenate([one.c.reshape(-1) for one in x])[order],
            np.concatenate([one.g.reshape(len(one.g), one.c.size) for one in x], 1)[:, order],
            np.concatenate([one.r.reshape(-1) for one in x])[order],
        ]
        return Enclosure(
            flat[0].reshape(shape), flat[1].reshape(-1, *shape), flat[2].reshape(shape)
        )
    if op in ("rsum", "rprod", "rmax", "rmin"):
        if op == "rsum":
            behind = tuple(a + 1 for a in attrs)
            total = x[0].size.sum(axis=attrs) * (1 + x[0].c.size)
            return _rounded(
                x[0].c.sum(axis=attrs), x[0].g.sum(axis=behind), x[0].r.sum(axis=attrs), total
            )
        if op == "rprod":
            raise UnboundedError("products over an axis have no enclosure here")
        extreme = np.max if op == "rmax" else np.min
        return _hull(extreme(x[0].low, axis=attrs), extreme(x[0].high, axis=attrs), x[0])
    if op == "matmul":
        return x[0] @ x[1]
    same = x[0] if len(x) == 2 and x[0] is x[1] else None
    x = [_widened(one, shape) for one in x]
    if same is not None:
        x[1] = x[0]
    if op == "add":
        return x[0] + x[1]
    if op == "sub":
        return x[0] - x[1]
    if op == "mul":
        return x[0] * x[1]
    if op == "neg":
        return -x[0]
    if op == "div":
        return x[0] * _smooth("reciprocal", x[1], chord=chord)
    if op == "pow":
        return _power(x[0], x[1], chord=chord)
    if op in ("max", "min"):
        a, b = (x[0], x[1]) if op == "max" else (x[1], x[0])
        pick = np.maximum if op == "max" else np.minimum
        hull = _hull(pick(a.low, b.low), pick(a.high, b.high), a)
        return _where(a.low >= b.high, x[0], _where(b.low >= a.high, x[1], hull))
    if op in ("lt", "le", "gt", "ge", "eq", "ne"):
        return _compare(op, x[0], x[1])
    if op == "select":
        yes, no = (x[0].low > 0) | (x[0].high < 0), (x[0].low >= 0) & (x[0].high <= 0)
        hull = _hull(np.minimum(x[1].low, x[2].low), np.maximum(x[1].high, x[2].high), x[0])
        return _where(yes, x[1], _where(no, x[2], hull))
    if op == "isfinite":
        return point(np.ones(shape), len(x[0].g))
    if op in ("sign", "floor"):
        function = np.sign if op == "sign" else np.floor
        return _hull(function(x[0].low), function(x[0].high), x[0])
    if op == "atan2":
        if (x[1].low <= 0).any():
            return _hull(np.full(shape, -math.pi), np.full(shape, math.pi), x[0])
        return _smooth("atan", x[0] * _smooth("reciprocal", x[1], chord=chord), chord=chord)
    return _smooth(op, x[0], chord=chord)


def _moved(op: str, attrs: Attributes, x: list[Array], shape: tuple[int, ...]) -> list[Array]:
    inputs = tuple(one.shape for one in x)
    node = Node(op, tuple(range(len(x))), attrs, shape)
    return evaluate(Program(inputs, (), (node,), (len(x),)), x)


def _widened(x: Enclosure, shape: tuple[int, ...]) -> Enclosure:
    if x.c.shape == shape:
        return x
    g = x.g.reshape(len(x.g), *[1] * len(shape))
    return Enclosure(
        np.broadcast_to(x.c, shape), np.broadcast_to(g, (len(g), *shape)),
        np.broadcast_to(x.r, shape),
    )  # fmt: skip


def _under_multiquadric(program: Program, node: Node) -> int | None:
    """Number of the value x where a node is sqrt(1 + x * x), which the enclosure of its parts would
    make wide and negative below the root; None for any other node."""
    first = len(program.inputs) + len(program.constants)
    if node.op != "sqrt" or node.operands[0] < first:
        return None
    added = program.nodes[node.operands[0] - first]
    for one, square in (added.operands, added.operands[::-1]) if added.op == "add" else ():
        k = one - len(program.inputs)
        if square < first or not 0 <= k < len(program.constants):
            continue
        product = program.nodes[square - first]
        if (program.constants[k] == 1.0).all() and product.op == "mul":
            a, b = product.operands
            return a if a == b else None
    return None


def enclose(
    program: Program, inputs: Sequence[Enclosure], *, chord: bool = False
) -> list[Enclosure]:
    """Enclose the outputs of a program for all inputs in sets of the same generators; `chord`:
    functions are replaced by the slope of their chord, else by the mean of their slopes. Raises
    UnboundedError where an operation has no finite enclosure."""
    program = program.plain
    generators = len(inputs[0].g) if inputs else 0
    values: list[Enclosure | list[Enclosure]] = [
        *inputs, *(point(c, generators) for c in program.constants)
    ]  # fmt: skip
    for node in program.nodes:
        read = [values[i] for i in node.operands]
        if node.op == "part":
            parts = read[0]
            assert isinstance(parts, list)
            values.append(parts[node.attrs[0]])
            continue
        x = [one for one in read if isinstance(one, Enclosure)]
        inner = _under_multiquadric(program, node)
        if inner is not None:
            signal = values[inner]
            assert isinstance(signal, Enclosure)
            values.append(_smooth(_MULTIQUADRIC, _widened(signal, node.shape), chord=chord))
            continue
        if node.op != "loop":
            values.append(_apply(node.op, node.attrs, x, node.shape, chord=chord))
            continue
        assert node.body is not None
        length, fixed, carried = node.attrs
        carry, rows = x[fixed : fixed + carried], x[fixed + carried :]
        stacked: list[list[Enclosure]] = []
        for k in range(length):
            here = [Enclosure(one.c[k], one.g[:, k], one.r[k]) for one in rows]
            found = enclose(node.body, [*x[:fixed], *carry, *here], chord=chord)
            carry = found[:carried]
            stacked.append(found[carried:])
        ends = [
            Enclosure(np.stack([s.c for s in one]), np.stack([s.g for s in one], 1),
                      np.stack([s.r for s in one]))
            for one in zip(*stacked, strict=True)
        ]  # fmt: skip
        values.append([*carry, *ends])
    outputs = [values[i] for i in program.outputs]
    return [one for one in outputs if isinstance(one, Enclosure)]


def reach(
    model: LoweredModel,
    start: Enclosure,
    u: tuple[Array, Array],
    steps: int,
    *,
    chord: bool = False,
) -> tuple[Array, Array, Enclosure]:
    """Enclose the outputs for all states of a set and all input sequences between two bounds.

    Args:
        model: lowered model
        start: set of states (n,) as one vector
        u: least and largest inputs (nu,)
        steps: number of samples
        chord: as for `enclose`

    Returns:
        lower and upper outputs (steps, ny), and the set of states after the last sample

    Raises:
        UnboundedError: where there is no finite enclosure
    """
    n, nu = len(start.c), model.nu
    # Generators kept; further ones are joined in a box.
    most = max(10 * (n + nu), _GENERATORS)
    sizes = [math.prod(shape) for shape in model.states]
    low, high = np.empty((steps, model.ny)), np.empty((steps, model.ny))
    box, state = interval(*u), start
    for k in range(steps):
        # The radii become generators, those of the inputs are new in each sample.
        g = np.concatenate([state.g, np.diag(state.r)[state.r > 0]])
        if len(g) > most:
            order = np.argsort(-np.abs(g / (1e-300 + np.abs(g).sum(axis=0))).sum(axis=1))
            g, rest = g[order[: most - n]], g[order[most - n :]]
            g = np.concatenate([g, np.diag(_up(np.abs(rest).sum(axis=0)))])
        m = len(g)
        g = np.concatenate([g, np.zeros((nu, n))])
        inputs = np.zeros((m + nu, nu))
        inputs[m:] = np.diag(box.r)
        parts = [
            Enclosure(c.reshape(s), one.reshape(len(g), *s), np.zeros(s))
            for c, one, s in zip(
                np.split(state.c, np.cumsum(sizes)[:-1]),
                np.split(g, np.cumsum(sizes)[:-1], axis=1), model.states, strict=True,
            )
        ]  # fmt: skip
        now = Enclosure(box.c, inputs, np.zeros(nu))
        y, *after = enclose(model.step, [*parts, now], chord=chord)
        low[k], high[k] = y.low, y.high
        state = Enclosure(
            np.concatenate([one.c.reshape(-1) for one in after]) if after else np.zeros(0),
            np.concatenate([one.g.reshape(len(g), one.c.size) for one in after], axis=1)
            if after else np.zeros((len(g), 0)),
            np.concatenate([one.r.reshape(-1) for one in after]) if after else np.zeros(0),
        )  # fmt: skip
    return low, high, state


_NOT_AFFINE = {
    "mul": "it multiplies signals",
    "matmul": "it multiplies signals",
    "div": "it divides by a signal",
    "select": "it switches on a signal",
}


def affine_matrices(model: LoweredModel) -> tuple[Enclosure, Enclosure, Enclosure, Enclosure]:
    """Enclosures of A, B, C, D of a step that is affine in states and input. Raises UnboundedError
    for any other step."""
    step, ny = model.step.plain, model.ny
    varies = [*[True] * len(step.inputs), *[False] * len(step.constants)]
    for node in step.nodes:
        moved = [varies[i] for i in node.operands]
        linear = node.op in _MOVES | {"add", "sub", "neg", "rsum"}
        linear |= node.op in ("mul", "matmul") and sum(moved) <= 1
        linear |= node.op == "div" and not moved[1]
        linear |= node.op == "select" and not moved[0]
        if any(moved) and not linear:
            what = _NOT_AFFINE.get(node.op, f"it takes {node.op} of a signal")
            raise UnboundedError(f"the step is not affine: {what}")
        varies.append(any(moved))
    shapes = step.inputs
    sizes = np.cumsum([math.prod(s) for s in shapes])

    def flat(x: Array) -> Enclosure:
        parts = [point(p.reshape(s)) for p, s in zip(np.split(x, sizes[:-1]), shapes, strict=True)]
        found = enclose(step, parts)
        return Enclosure(
            np.concatenate([one.c.reshape(-1) for one in found]), np.zeros((0, sizes[-1])),
            np.concatenate([one.r.reshape(-1) for one in found]),
        )  # fmt: skip

    rest = flat(np.zeros(sizes[-1]))
    total = sizes[-1] - model.nu + ny
    rest = Enclosure(rest.c, np.zeros((0, total)), rest.r)
    columns: list[Enclosure] = []
    for unit in np.eye(sizes[-1]):
        one = flat(unit)
        columns.append(Enclosure(one.c, np.zeros((0, total)), one.r) - rest)
    c, r = (np.stack([getattr(one, side) for one in columns], axis=1) for side in ("c", "r"))
    n = total - ny

    def part(rows: slice, cols: slice) -> Enclosure:
        return Enclosure(c[rows, cols], np.zeros((0, *c[rows, cols].shape)), r[rows, cols])

    x, y = slice(ny, None), slice(0, ny)
    return (
        part(x, slice(0, n)),
        part(x, slice(n, None)),
        part(y, slice(0, n)),
        part(y, slice(n, None)),
    )
