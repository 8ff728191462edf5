"""Structural identifiability of given equations: parameters that no record can determine.

Outputs are simulated from random states with random inputs. Their derivatives by all parameters and
initial states form the observability-identifiability matrix; a direction in its null space changes
parameters and no output. A direction that remains at several random points is structural. Sources:
Stigter and Molenaar, Automatica 58, 2015 (rank of the sensitivities); Martins, Sturdza and Alonso,
ACM TOMS 29(3), 2003 (derivatives by complex steps).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array, Trajectory
from asia.problem.memory import LEAST_TIME, expanded
from asia.problem.physics import (
    NAMED_NUMBERS,
    Expression,
    Node,
    ParameterRange,
    Physics,
    names_in,
    parse_expression,
)

ComplexArray: TypeAlias = NDArray[np.complex128]

_POINTS, _DRAWS = 2, 4
# Sampling intervals of the simulations in samples of the records, samples of each, and evaluations.
_INTERVALS, _SAMPLES, _MOST_EVALUATIONS = (1.0, 10.0, 100.0), 16, 2_500
# Singular values below this share of the largest belong to the null space: integration is exact to
# 1e-12.
_NULL = 1e-9
_STEP = 1e-30


@dataclass(frozen=True)
class Unidentifiable:
    """Parameters that no record can determine one by one."""

    parameters: tuple[str, ...]
    directions: int
    """Number of independent changes of them that leave all outputs as they are."""
    combinations: tuple[str, ...]
    """Expressions of them that records determine; empty where no simple one was found."""
    has_priors: bool
    """Whether the priors of the problem file decide between them."""

    def __str__(self) -> str:
        names = ", ".join(self.parameters)
        if len(self.parameters) == self.directions:
            verb = "it does" if len(self.parameters) == 1 else "they do"
            return f"no record can determine {names}: {verb} not act on any output"
        known = " and ".join(self.combinations)
        count = len(self.parameters) - self.directions
        what = known or f"{count} combination{'s' if count > 1 else ''} of them"
        if self.has_priors:
            advice = "[physics.priors] decides the rest"
        else:
            many = "one of them" if self.directions == 1 else f"{self.directions} of them"
            advice = f"fix {many} in [physics.constants], or add a prior"
        return f"no record can determine {names} one by one, only {what}: {advice}"


def unidentifiable(
    physics: Physics, inputs: Sequence[str], outputs: Sequence[str], records: Sequence[Trajectory]
) -> list[Unidentifiable] | None:
    """Find the parameters that no record can determine.

    Args:
        physics: checked equations
        inputs, outputs: names of the signals
        records: training records, for ranges of inputs and states and the sampling time

    Returns:
        one entry for each group of parameters; None where the equations could not be simulated, or
        have delays, which the check cannot follow
    """
    names = tuple(physics.parameters)
    if not names:
        return []
    model, rng = _Equations(physics, inputs, outputs), np.random.default_rng(0)
    if model.delays:
        return None
    found: list[tuple[Array, Array]] = []
    for _ in range(_DRAWS):
        theta = np.array([_drawn(one, rng) for one in physics.parameters.values()])
        null = _null_space(model, theta, records, rng)
        if null is not None and null.shape[1] == 0:
            return []
        if null is not None:
            found.append((theta, null))
        if len(found) == _POINTS:
            break
    if not found:
        return None
    # A parameter may have less influence at a point by chance, never more.
    least = min(null.shape[1] for _, null in found)
    points = [(theta, null) for theta, null in found if null.shape[1] == least]
    shares = [null @ np.linalg.pinv(null) for _, null in points]
    linked = np.max(np.abs(shares), axis=0) > 1e-5
    groups: list[Unidentifiable] = []
    left = [i for i in range(len(names)) if linked[i, i]]
    while left:
        group, more = [left[0]], True
        while more:
            new = [i for i in left if i not in group and linked[i, group].any()]
            group, more = sorted({*group, *new}), bool(new)
        left = [i for i in left if i not in group]
        count = int(np.linalg.matrix_rank(points[0][1][group], rtol=1e-4))
        own = tuple(names[i] for i in group)
        parts = [(theta[group], null[group]) for theta, null in points]
        combinations = _combinations(own, parts, count)
        decided = _priors_decide(physics, names, points[0], group, count)
        groups.append(Unidentifiable(own, count, combinations, decided))
    return groups


def _drawn(span: ParameterRange, rng: np.random.Generator) -> float:
    """Random value inside a range, where its ends do not dominate."""
    share = rng.uniform(0.2, 0.8)
    if span.min > 0:
        return float(span.min * (span.max / span.min) ** share)
    return float(span.min + share * (span.max - span.min))


def _smaller(*values: Any) -> Any:
    least = values[0]
    for value in values[1:]:
        least = np.where(np.real(value) < np.real(least), value, least)
    return least


def _larger(*values: Any) -> Any:
    return -_smaller(*(-value for value in values))


def _absolute(x: Any) -> Any:
    return np.where(np.real(x) < 0, -x, x)


def _angle(y: Any, x: Any) -> Any:
    turn = np.arctan2(np.real(y), np.real(x))
    size = np.real(x) ** 2 + np.real(y) ** 2
    return turn + 1j * (np.real(x) * np.imag(y) - np.real(y) * np.imag(x)) / size


_Formula: TypeAlias = Callable[[Mapping[str, Any]], Any]
# Functions of expressions, analytic along the imaginary axis.
_FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in (
        "exp", "log", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh",
    )},
    "sqrt": lambda x: np.sqrt(np.where(np.real(x) > 0, x, 0.0)),
    "sigmoid": lambda x: 0.5 + 0.5 * np.tanh(0.5 * x),
    "softplus": lambda x: _larger(x, 0.0) + np.log1p(np.exp(-_absolute(x))),
    "abs": _absolute,
    "sign": lambda x: np.sign(np.real(x)) + 0j,
    "arctan2": _angle,
    "min": _smaller,
    "max": _larger,
    "clip": lambda x, low, high: _smaller(_larger(x, low), high),
}  # fmt: skip


class _Equations:
    """Right-hand sides and outputs of a physics section, for any number of columns at once."""

    def __init__(self, physics: Physics, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        def formulas(nodes: Iterable[Node]) -> list[_Formula]:
            return [Expression("", n, names_in(n)).compiled(_FUNCTIONS) for n in nodes]

        found = expanded(physics, outputs)
        self.physics, self.inputs, self.states = physics, inputs, found.states
        self.delays = found.delays
        self.defined = tuple(name for name, _ in found.definitions)
        self.definitions = formulas(node for _, node in found.definitions)
        self.dynamics = formulas(found.dynamics)
        self.observation = formulas(found.observation)

    def values(self, which: Sequence[_Formula], x: Any, u: Array, theta: Any) -> ComplexArray:
        """Values (len(which), columns) at states x (nx, columns) and parameters (p, columns)."""
        named: dict[str, Any] = {**NAMED_NUMBERS, **self.physics.constants}
        named |= dict.fromkeys((*self.physics.corrections, LEAST_TIME), 0.0)
        named |= zip(self.states, x, strict=True)
        named |= zip(self.inputs, u, strict=True)
        named |= zip(self.physics.parameters, theta, strict=True)
        for name, definition in zip(self.defined, self.definitions, strict=True):
            named[name] = definition(named)
        found = np.empty((len(which), *x.shape[1:]), np.complex128)
        for k, formula in enumerate(which):
            found[k] = formula(named)
        return found


class _StoppedError(Exception):
    """The states diverge, or the simulation takes more evaluations than a check may."""


def _null_space(
    model: _Equations, theta: Array, records: Sequence[Trajectory], rng: np.random.Generator
) -> Array | None:
    """Changes of the parameters (p, k) that leave all outputs as they are, whatever the initial
    states; None where nothing could be simulated."""
    size, states = len(theta), len(model.states)
    blocks = [
        block
        for interval in _INTERVALS
        if (block := _sensitivities(model, theta, records, rng, interval)) is not None
    ]
    if not blocks:
        return None
    # Initial states are unknown and differ from simulation to simulation.
    matrix = np.zeros((sum(map(len, blocks)), states * len(blocks) + size))
    row = 0
    for k, block in enumerate(blocks):
        rows = slice(row, row + len(block))
        matrix[rows, k * states : (k + 1) * states] = block[:, :states]
        matrix[rows, -size:] = block[:, states:]
        row += len(block)
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 1e-200, scale, 1.0)
    _, sizes, right = np.linalg.svd(matrix / scale)
    sizes = np.append(sizes, np.zeros(len(right) - len(sizes)))
    null = (right[sizes <= _NULL * sizes[0]].T / scale[:, None])[-size:]
    # Without the directions that move initial states alone.
    relative = null * scale[-size:, None]
    left, kept, _ = np.linalg.svd(relative, full_matrices=False)
    return (left / scale[-size:, None])[:, kept > 1e-5]


def _sensitivities(
    model: _Equations,
    theta: Array,
    records: Sequence[Trajectory],
    rng: np.random.Generator,
    interval: float,
) -> Array | None:
    """Derivatives (samples * ny, nx + p) of the outputs of one simulation by initial states and
    parameters; None where it fails early."""
    from scipy.integrate import solve_ivp

    physics, count = model.physics, len(model.states)
    step = records[0].sampling_time * interval
    low = np.min([r.u.min(axis=0) for r in records], axis=0)
    high = np.max([r.u.max(axis=0) for r in records], axis=0)
    y = np.concatenate([r.measured_y for r in records])
    size = float(np.nanmedian(np.abs(y))) or 1.0
    x = np.empty(count)
    for i, name in enumerate(model.states):
        bounds = physics.bounds.get(name)
        least = bounds.min if bounds and bounds.min is not None else -np.inf
        most = bounds.max if bounds and bounds.max is not None else np.inf
        x[i] = np.clip(rng.uniform(0.3, 1.0) * size, least, most)
    columns = count + len(theta)
    moved = np.concatenate([x, theta])[:, None] + 1j * _STEP * np.eye(columns)
    x_now, parameters = moved[:count], moved[count:]
    used, rows = 0, list[Array]()

    def rate(_: float, flat: ComplexArray, u: Array) -> ComplexArray:
        nonlocal used
        used += 1
        if used > _MOST_EVALUATIONS or not np.abs(flat).max() < 1e6 * (1.0 + size):
            raise _StoppedError
        return model.values(model.dynamics, flat.reshape(count, -1), u, parameters).ravel()

    with np.errstate(all="ignore"):
        for _ in range(_SAMPLES):
            u = rng.uniform(low, high)
            try:
                done: Any = solve_ivp(
                    rate, (0.0, step), x_now.ravel(), "DOP853", args=(u,), rtol=1e-12,
                    atol=1e-13 * size, t_eval=[step],
                )  # fmt: skip
            except (_StoppedError, FloatingPointError):
                break
            if not done.success or not np.isfinite(done.y).all():
                break
            x_now = done.y[:, -1].reshape(count, -1)
            outputs = model.values(model.observation, x_now, u, parameters)
            if not np.isfinite(outputs).all():
                break
            rows.append(outputs.imag / _STEP)
    return np.concatenate(rows) if len(rows) * len(model.observation) > columns // 3 else None


_SUBSTEPS, _SETTLING = 2, 3_000


class ParameterChanges:
    """Effects of changes of the parameters on simulated outputs: half the difference between both
    signs, so that a root at an empty tank counts no more than it changes. Runge-Kutta scheme of
    order four; the states are at rest before."""

    def __init__(
        self,
        physics: Physics,
        signals: tuple[Sequence[str], Sequence[str]],
        values: Mapping[str, float],
        directions: Array,
        rest: tuple[Array, Array],
        sampling_time: float,
    ) -> None:
        """Find the state at rest.

        Args:
            signals: names of inputs and outputs
            values: of all parameters
            directions: changes (q, p), in the order of the physics section
            rest: input (nu,) and output (ny,) before
            sampling_time: s
        """
        self._model, self._step = _Equations(physics, *signals), sampling_time / _SUBSTEPS
        theta = np.array([values[name] for name in physics.parameters])[:, None]
        self._theta = theta + np.concatenate([directions, -directions]).T
        typical = float(np.median(np.abs(rest[1]))) or 1.0
        # States that are outputs begin there.
        known = zip(signals[1], rest[1], strict=True)
        seen = {physics.observation.get(name, name): value for name, value in known}
        columns = self._theta.shape[1]
        first = [[seen.get(name, typical)] * columns for name in self._model.states]
        x: ComplexArray = np.array(first, np.complex128)
        # States that settle at zero are small beside those on the way.
        size = np.abs(x).max()
        with np.errstate(all="ignore"):
            for _ in range(_SETTLING):
                before, x = x, self._after(x, rest[0][:, None], self._theta)
                size = np.maximum(size, np.abs(x).max())
                if np.abs(x - before).max() <= 1e-9 * size:
                    break
        self._rest = x

    def _after(self, x: ComplexArray, u: Array, theta: Any) -> ComplexArray:
        """States (nx, columns) a sample later."""
        model, step = self._model, self._step
        for _ in range(_SUBSTEPS):
            k1 = model.values(model.dynamics, x, u, theta)
            k2 = model.values(model.dynamics, x + 0.5 * step * k1, u, theta)
            k3 = model.values(model.dynamics, x + 0.5 * step * k2, u, theta)
            k4 = model.values(model.dynamics, x + step * k3, u, theta)
            x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x

    def __call__(self, u: Array) -> Array:
        """Inputs (B, H, nu) -> changes (q, B, H, ny), not finite where the equations diverge."""
        cases, size = len(u), self._theta.shape[1]
        x, theta = np.tile(self._rest, (1, cases)), np.tile(self._theta, (1, cases))
        found: list[Array] = []
        with np.errstate(all="ignore"):
            for k in range(u.shape[1]):
                held = np.repeat(u[:, k].T, size, axis=1)
                seen = self._model.values(self._model.observation, x, held, theta)
                found.append(seen.real)
                x = self._after(x, held, theta)
        y = np.stack(found).reshape(len(found), -1, cases, 2, size // 2)
        return 0.5 * (y[..., 0, :] - y[..., 1, :]).transpose(3, 2, 0, 1)


def _rational(values: Array) -> list[Fraction] | None:
    """Small fractions that these numbers are, or None."""
    found = [Fraction(float(v)).limit_denominator(4) for v in values]
    close = np.abs([float(f) - v for f, v in zip(found, values, strict=True)]).max() < 1e-4
    return found if close and max(abs(f) for f in found) <= 6 else None


def _reduced_rows(null: Array) -> Array:
    """Reduced row echelon basis of the combinations that a null space leaves alone."""
    left, _, _ = np.linalg.svd(null)
    rows = left[:, np.linalg.matrix_rank(null, rtol=1e-4) :].T
    for k in range(len(rows)):
        pivot = next((j for j in range(k, rows.shape[1]) if np.abs(rows[k:, j]).max() > 1e-5), None)
        if pivot is None:
            break
        best = k + int(np.argmax(np.abs(rows[k:, pivot])))
        rows[[k, best]] = rows[[best, k]]
        rows[k] /= rows[k, pivot]
        others = [i for i in range(len(rows)) if i != k]
        rows[others] -= np.outer(rows[others, pivot], rows[k])
    return rows


def _combinations(
    names: Sequence[str], points: Sequence[tuple[Array, Array]], directions: int
) -> tuple[str, ...]:
    """Products of powers, or else sums, of the parameters that are the same at all points."""
    if directions == len(names):
        return ()
    for relative in (True, False):
        bases = [_reduced_rows(null / theta[:, None] if relative else null / np.abs(null).max())
                 for theta, null in points]  # fmt: skip
        if any(np.abs(one - bases[0]).max() > 1e-4 for one in bases):
            continue
        rows = [_rational(row) for row in bases[0]]
        if all(row is not None for row in rows):
            texts = [_product if relative else _sum for _ in rows]
            return tuple(
                text(names, row) for text, row in zip(texts, rows, strict=True) if row is not None
            )
    return ()


def _product(names: Sequence[str], powers: Sequence[Fraction]) -> str:
    whole = np.lcm.reduce([p.denominator for p in powers])
    above, below = list[str](), list[str]()
    for name, power in zip(names, powers, strict=True):
        size = abs(power) * whole
        if size:
            (above if power > 0 else below).append(name if size == 1 else f"{name}**{size}")
    text = "*".join(above) or "1"
    return text + (f"/({'*'.join(below)})" if len(below) > 1 else f"/{below[0]}" if below else "")


def _sum(names: Sequence[str], weights: Sequence[Fraction]) -> str:
    text = ""
    for name, weight in zip(names, weights, strict=True):
        if weight:
            size = "" if abs(weight) == 1 else f"{float(abs(weight)):g}*"
            text += f" {'-' if weight < 0 else '+'} {size}{name}"
    return text.removeprefix(" + ").strip()


def _priors_decide(
    physics: Physics,
    names: Sequence[str],
    point: tuple[Array, Array],
    group: Sequence[int],
    directions: int,
) -> bool:
    """Whether the priors change along every direction of the group's null space."""
    theta, null = point
    moved = theta[:, None] + 1j * _STEP * np.eye(len(theta))
    named = {**NAMED_NUMBERS, **physics.constants, **dict(zip(names, moved, strict=True))}
    slopes = [
        np.imag(parse_expression(text, "prior").evaluate(named, _FUNCTIONS)) / _STEP * theta
        for text in physics.priors
    ]
    if not slopes:
        return False
    own = (null / theta[:, None])[group]
    along = np.array([row / np.linalg.norm(row) for row in slopes])[:, group]
    return int(np.linalg.matrix_rank(along @ (own / np.linalg.norm(own, axis=0)), tol=1e-6)) >= (
        directions
    )
