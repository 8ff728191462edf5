"""LQR and model predictive control on a linear model, with a disturbance observer.

A Kalman filter estimates the states and a constant disturbance at the input, whose compensation is
the integral action (Pannocchia and Rawlings, AIChE J. 49, 2003). It gets the limited input, so it
does not wind up. The LQR minimises the sum of (y - r)^2 and weighted squares of the input. The MPC
minimises the same sum in each sample within the limits of the input and its rate: a quadratic
program, solved as least-distance programming (Lawson and Hanson, Solving Least Squares Problems,
chapter 23). Without an active limit it is the LQR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from asia.analysis.control import (
    Design,
    Designer,
    Language,
    Limits,
    Loop,
    LoopFigures,
    SampledController,
    Specification,
    margins,
    response_figures,
    zero_order_hold,
)
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.lowering.linear import LinearModel, minimal, reduced

# Weights of the input that are tried, in units of the squared gain of the plant, and variances of
# the disturbance in those of the noise. Observers are tried in this order, counted from the slowest
# one that is as fast as the regulator.
_WEIGHTS, _DISTURBANCES = np.geomspace(1e2, 1e-5, 22), np.geomspace(1e-8, 1e8, 33)
_OBSERVERS, _HALVINGS = (0, 2, 4, -2, 6, -4, -6, 10), 4
_RESERVE, _NEGLIGIBLE = 0.02, 1e-4
_GRID, _LONGEST = 200, 3_000
# Samples of a settling time, and those that a plan has.
_SAMPLES, _MOVES = 100, (10, 40)


@dataclass(frozen=True)
class PredictiveController(SampledController):
    """Observer with a plan of the next inputs, which is moved into the limits."""

    plan: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Next N inputs without limits, as deviations from u0, by the state and (r, y): (N, n + 2)."""
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Upper triangular (N, N): its square is the Hessian of the cost of the plan."""

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """Constraints G u >= h on a plan, where the last input is at u0, and G root^-1."""
        moves, n = np.eye(len(self.plan)), len(self.plan)
        changes, most = moves - np.eye(n, k=-1), self.rate * self.sampling_time
        parts = [
            (moves, self.low - self.u0), (-moves, self.u0 - self.high),
            (changes, -most), (-changes, -most),
        ]  # fmt: skip
        used = [np.column_stack([rows, np.full(n, h)]) for rows, h in parts if math.isfinite(h)]
        joined = np.vstack([np.zeros((0, n + 1)), *used])
        scaled = np.linalg.solve(self.root.T, joined[:, :n].T).T
        return joined, np.asarray(scaled, np.float64)

    def wanted(self, x: Array, last: float, r: float, y: float) -> float:
        """First input of the plan within the limits that costs least."""
        from scipy.optimize import nnls

        plan = self.plan @ np.concatenate([x, [r - self.y0, y - self.y0]])
        rows, scaled = self.rows
        h = rows[:, -1] - rows[:, :-1] @ plan
        if math.isfinite(self.rate):
            # The first change is counted from the last input.
            n = len(plan)
            h[-2 * n] += last - self.u0
            h[-n] -= last - self.u0
        size = float(h.max(initial=0.0))
        if size <= 0.0:
            return self.u0 + float(plan[0])
        ones = np.append(np.zeros(len(plan)), 1.0)
        matrix = np.vstack([scaled.T, h / size])
        try:
            rest = ones - matrix @ nnls(matrix, ones)[0]
        except RuntimeError:
            return self.u0 + float(plan[0])
        moved = np.linalg.solve(self.root, size * rest[:-1] / -max(rest[-1], 1e-12))
        return self.u0 + float(plan[0] + moved[0])

    def code(self, language: Language) -> str:
        """Source of a Python class that needs NumPy and SciPy; there is no other language."""
        if language != "python":
            raise UserError("a predictive controller has code in Python only")
        names = {one.name for one in fields(self)} - {"plan", "root"}
        scalars = [n for n in names if not isinstance(getattr(self, n), np.ndarray)]
        rows, scaled = self.rows
        arrays = {n: getattr(self, n) for n in ("a", "b", "plan", "root")}
        arrays |= {"rows": rows, "scaled": scaled}
        lines = [f"    {n} = {getattr(self, n)!r}" for n in sorted(scalars)]
        lines += [f"    {n} = np.array({value.tolist()})" for n, value in arrays.items()]
        given = "\n".join(lines).replace("= inf", "= np.inf").replace("= -inf", "= -np.inf")
        return _CODE.format(given=given, time=self.sampling_time, order=len(self.c))


_CODE = '''import numpy as np
from scipy.optimize import nnls


class Controller:
    """Call once every {time:g} s: set point r and output y to input u."""

{given}

    def __init__(self, u=u0):
        self.last, self.x = u, np.zeros({order})

    def step(self, r, y):
        seen = np.array([r - self.y0, y - self.y0])
        plan = self.plan @ np.append(self.x, seen)
        n = len(plan)
        h = self.rows[:, -1] - self.rows[:, :-1] @ plan
        if np.isfinite(self.rate):
            h[-2 * n] += self.last - self.u0
            h[-n] -= self.last - self.u0
        u, size = self.u0 + plan[0], max(h.max(initial=0.0), 0.0)
        if size > 0:
            ones = np.append(np.zeros(n), 1.0)
            matrix = np.vstack([self.scaled.T, h / size])
            try:
                rest = ones - matrix @ nnls(matrix, ones)[0]
                u += np.linalg.solve(self.root, size * rest[:-1] / -max(rest[-1], 1e-12))[0]
            except RuntimeError:
                pass
        u = min(max(u, self.low), self.high)
        most = self.rate * self.sampling_time
        u = min(max(u, self.last - most), self.last + most)
        self.x = self.a @ self.x + self.b @ np.append(seen, u - self.u0)
        self.last = u
        return u
'''


@dataclass(frozen=True)
class _Plant:
    """x[k+1] = A x[k] + B u[k]; the controller sees C x."""

    a: Array
    b: Array
    c: Array

    @classmethod
    def seen(cls, model: LinearModel, *, late: bool) -> _Plant:
        """Plant whose output does not have the input of its own sample: with `late` the controller
        sees the output of the sample before."""
        if not late:
            return cls(model.a, model.b, model.c)
        n = model.order
        a = np.block([[model.a, np.zeros((n, 1))], [model.c, np.zeros((1, 1))]])
        return cls(a, np.vstack([model.b, model.d]), np.append(np.zeros(n), 1.0)[None])


def _riccati(a: Array, b: Array, q: Array, r: float) -> Array:
    from scipy.linalg import solve_discrete_are

    eye = 1e-12 * (np.trace(q) + 1e-300) * np.eye(len(a))
    return np.asarray(solve_discrete_are(a, b, q + eye, np.array([[r]])), np.float64)


def _radius(a: Array) -> float:
    return float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))


class _Synthesis:
    """Controllers of one plant: observers for several disturbances, regulators by weight."""

    def __init__(self, plant: _Plant, pace: float) -> None:
        a, b, c = plant.a, plant.b, plant.c
        n = len(a)
        whole = np.block([[a - np.eye(n), b], [c, np.zeros((1, 1))]])
        if np.linalg.cond(whole) > 1e12:
            raise UserError(
                "a constant input does not move the output: no controller with integral action "
                "holds a set point"
            )
        # States and input that hold the output 1.
        target = np.linalg.solve(whole, np.append(np.zeros(n), 1.0))
        self.plant, self.rest, self.hold = plant, target[:n], float(target[n])
        # Squared gain at the pace of the loop, in rad a sample.
        there = c @ np.linalg.solve(np.exp(1j * pace) * np.eye(n) - a, b + 0j)
        self.size = max(float(np.abs(there[0, 0])) ** 2, 1e-300)
        self.joint = np.block([[a, b], [np.zeros((1, n)), np.eye(1)]])
        self.row = np.append(c, 0.0)[None]
        self.observers: list[tuple[float, Array]] = []
        drive = np.append(b, 1.0)[:, None]
        for share in _DISTURBANCES / self.size:
            try:
                s = _riccati(self.joint.T, self.row.T, share * drive @ drive.T, 1.0)
            except (np.linalg.LinAlgError, ValueError):
                continue
            gain = s @ self.row.T / (1.0 + float((self.row @ s @ self.row.T)[0, 0]))
            radius = _radius(self.joint - self.joint @ gain @ self.row)
            if radius < 1.0 - 1e-9:
                self.observers.append((radius, gain))
        if not self.observers:
            raise UserError("no observer was found for the linear model")

    def controller(
        self, weight: float, observer: int, base: SampledController, moves: int
    ) -> SampledController | None:
        """LQR with this weight of the input and an observer, counted as in `_OBSERVERS`; with
        moves > 0 the MPC. `base` has operating point and limits."""
        a, b, c = self.plant.a, self.plant.b, self.plant.c
        n = len(a)
        try:
            p = _riccati(a, b, c.T @ c, weight)
        except (np.linalg.LinAlgError, ValueError):
            return None
        gain = (b.T @ p @ a) / (weight + float((b.T @ p @ b)[0, 0]))
        closed = a - b @ gain
        # The time constants agree to 5 %.
        radius = max(_radius(closed), min(self.observers, key=lambda one: one[0])[0]) ** 0.95
        equal = next((k for k, one in enumerate(self.observers) if one[0] <= radius), 0)
        last = len(self.observers) - 1
        _, estimate = self.observers[min(max(equal + observer, 0), last)]
        # States and disturbance after the measurement, by the state before, r and y.
        eye = np.eye(n + 1)
        known = np.hstack([eye - estimate @ self.row, np.zeros((n + 1, 1)), estimate])
        away, held = known[:n].copy(), -known[n].copy()
        away[:, n + 1] -= self.rest
        held[n + 1] += self.hold
        law = held - (gain @ away)[0]
        made = replace(
            base, a=self.joint @ known[:, : n + 1],
            b=np.hstack([self.joint @ known[:, n + 1 :], np.append(b, 0.0)[:, None]]),
            c=law[: n + 1], d=law[n + 1 :],
        )  # fmt: skip
        if not moves:
            return made
        plan, power = np.empty((moves, n + 3)), np.eye(n)
        moved, cost = np.zeros((n, moves)), weight * np.eye(moves)
        for k in range(moves):
            plan[k] = held - (gain @ power @ away)[0]
            power = closed @ power
            moved = a @ moved
            moved[:, k] += b[:, 0]
            cost += moved.T @ (p if k == moves - 1 else c.T @ c) @ moved
        root = np.asarray(np.linalg.cholesky(cost).T, np.float64)
        values = {one.name: getattr(made, one.name) for one in fields(made)}
        return PredictiveController(**values, plan=plan, root=root)


def sampled_loop_figures(plant: _Plant, controller: SampledController, load: float) -> LoopFigures:
    """Compute margins at the input of the plant, and the responses to steps of the set point and of
    a load at the input of this size, of a sampled loop without limits."""
    n, c, d = len(plant.a), controller.c[None], controller.d
    inner = controller.a + controller.b[:, 2:] @ c
    into = controller.b[:, :2] + controller.b[:, 2:] * d
    a = np.block([
        [plant.a + d[1] * plant.b @ plant.c, plant.b @ c],
        [into[:, 1:] @ plant.c, inner],
    ])  # fmt: skip
    radius = _radius(a)
    if not radius < 1.0 - 1e-9:
        return LoopFigures(False, 1.0, 1.0, 0.0, math.inf, math.inf, math.inf)
    time = controller.sampling_time

    def response(w: Array) -> NDArray[np.complex128]:
        z = np.exp(1j * w * time)[:, None, None]
        there = plant.c @ np.linalg.solve(z * np.eye(n) - plant.a, plant.b + 0j)
        back = c @ np.linalg.solve(z * np.eye(len(inner)) - inner, into[:, 1:] + 0j) + d[1]
        return np.asarray(-(there * back)[:, 0, 0], np.complex128)

    nyquist = math.pi / time
    w = np.geomspace(1e-5 * nyquist, nyquist, _GRID)
    for matrix in (plant.a, inner):
        poles = np.linalg.eigvals(matrix)
        corners = np.abs(np.log(poles[np.abs(poles) > 1e-6] + 0j)) / time
        w = np.append(w, np.outer(corners, (0.97, 0.99, 1.0, 1.01, 1.03)).reshape(-1))
    w = np.unique(w[(w >= 1e-5 * nyquist) & (w <= nyquist)])
    last = float(response(np.array([nyquist]))[0].real)
    low, high, phase, late = margins(w, response, (last,))
    samples = int(min(max(math.log(1e-4) / math.log(max(radius, 1e-3)), 50), _LONGEST))
    push = np.stack([
        np.concatenate([plant.b[:, 0] * d[0], into[:, 0]]),
        np.concatenate([plant.b[:, 0] * load, np.zeros(len(inner))]),
    ], axis=1)  # fmt: skip
    x, y = np.zeros((len(a), 2)), np.empty((samples, 2))
    for k in range(samples):
        y[k] = plant.c[0] @ x[:n]
        x = a @ x + push
    one, other = (
        response_figures(part, np.zeros(samples), replace(controller, u0=0.0, y0=0.0), 1.0)
        for part in (y[:, 0], 1.0 + y[:, 1])
    )
    final = float(plant.c[0] @ np.linalg.solve(np.eye(len(a)) - a, push[:, 0])[:n])
    return LoopFigures(True, low, high, phase, one.settling, one.overshoot, 1.0 - final, late,
                       one.rise, load_settling=other.settling)  # fmt: skip


def _sampled_plants(loop: Loop, wanted: Specification) -> Loop:
    """Loop with the sampled linear model of a plant that is a transfer function."""
    if loop.models:
        return loop
    if not loop.sampling_time:
        settling = wanted.settling_max or loop.own_settling or 1.0
        loop = replace(loop, sampling_time=float(f"{settling / _SAMPLES:.1g}"))
    held = zero_order_hold(loop.plants[0], loop.sampling_time)
    n, step = len(held.starts[0]), held.steps[0]
    each = [step(one[:n], float(one[n])) for one in np.eye(n + 1)]
    whole = np.stack([np.append(y, after) for y, after in each], axis=1)
    model = LinearModel(
        whole[1:, :n], whole[1:, n:], whole[:1, :n], whole[:1, n:], loop.sampling_time,
        np.zeros(1), np.zeros(1),
    )  # fmt: skip
    return replace(loop, models=[minimal(model)], simulated=[replace(held, name="loop")])


def state_feedback_designer(
    limits: Limits, *, predictive: bool = False, weights: tuple[float, float] | None = None,
    moves: int | None = None,
) -> Designer:  # fmt: skip
    """Designer of the LQR, or the MPC, on the first linear model of a loop that meets the
    specifications for all of them without limits, with the largest weight of the input that does.

    Args:
        predictive: whether the MPC is designed
        weights: of squared errors of y and of squared inputs; None: sought
        moves: planned inputs of the MPC; None: 10 to 40, by the speed of the loop
    """

    def designed(
        loop: Loop, wanted: Specification
    ) -> tuple[Loop, Design, list[LoopFigures], SampledController]:
        loop, none = _sampled_plants(loop, wanted), np.zeros(0)
        base = SampledController(none, none, none, none, loop.sampling_time, loop.u0, loop.y0,
                                 limits.low, limits.high, limits.rate)  # fmt: skip
        return loop, *_design(loop, wanted, base, predictive, weights, moves)

    return designed


def _design(
    loop: Loop, wanted: Specification, base: SampledController, predictive: bool,
    weights: tuple[float, float] | None, moves: int | None,
) -> tuple[Design, list[LoopFigures], SampledController]:  # fmt: skip
    late = loop.simulated[0].late
    plants = [_Plant.seen(one, late=late) for one in loop.models]
    first = _Plant.seen(reduced(loop.models[0], tolerance=_NEGLIGIBLE).model, late=late)
    settling = wanted.settling_max or _SAMPLES * base.sampling_time
    synthesis = _Synthesis(first, 4.0 * base.sampling_time / settling)
    # The load asks for as much input as a unit step of the set point.
    load = abs(synthesis.hold) if abs(synthesis.hold) > 1e-9 else synthesis.size**-0.5
    if weights is None:
        tried: Sequence[float] = (synthesis.size * _WEIGHTS).tolist()
    else:
        tried = [weights[1] / weights[0]]
    best: tuple[float, float, int, list[LoopFigures]] | None = None

    def meets(weight: float) -> bool:
        """Whether an LQR with this weight meets all specifications; the best one is kept."""
        nonlocal best
        for observer in _OBSERVERS:
            made = synthesis.controller(weight, observer, base, 0)
            if made is None:
                continue
            each = [sampled_loop_figures(one, made, load) for one in plants]
            worst = max(sum(v for _, v in one.violations(wanted, _RESERVE)) for one in each)
            if best is None or worst < best[0] or worst <= 0.0:
                best = worst, weight, observer, each
            if worst <= 0.0:
                return True
        return False

    found = next((k for k, weight in enumerate(tried) if meets(weight)), 0)
    if found:
        high, low = tried[found - 1], tried[found]
        for _ in range(_HALVINGS):
            middle = math.sqrt(high * low)
            high, low = (high, middle) if meets(middle) else (middle, low)
    if best is None:
        raise UserError("no LQR was found for the linear model: its Riccati equation has no answer")
    _, weight, observer, each = best
    if moves is None and predictive:
        needed = each[0].settling / base.sampling_time if math.isfinite(each[0].settling) else 1e9
        moves = int(min(max(needed, _MOVES[0]), _MOVES[1]))
    made = synthesis.controller(weight, observer, base, (moves or 0) if predictive else 0)
    assert made is not None
    name = f"MPC of {moves} moves" if predictive else "LQR"
    missed = sorted({one for figures in each for one, _ in figures.violations(wanted)})
    return (
        Design(f"{name} with an observer of {len(made.c)} states", None, each[0], tuple(missed),
               (1.0, weight)),
        each, made,
    )  # fmt: skip
