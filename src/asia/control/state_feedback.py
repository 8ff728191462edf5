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

from asia._progress import tracked
from asia.control.design import (
    ControlledPlant,
    Design,
    Designer,
    Language,
    Limits,
    Loop,
    LoopFigures,
    SampledController,
    Specification,
    sampled_loop_figures,
    spectral_radius,
)
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.lowering.linear import reduced

# Weights of the input that are tried, in units of the squared gain of the plant, and variances of
# the disturbance in those of the noise. Observers are tried in this order, counted from the slowest
# one that is as fast as the regulator.
_WEIGHTS, _DISTURBANCES = np.geomspace(1e2, 1e-5, 22), np.geomspace(1e-8, 1e8, 33)
_OBSERVERS, _HALVINGS = (0, 2, 4, -2, 6, -4, -6, 10), 4
_RESERVE, _NEGLIGIBLE = 0.02, 1e-4
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

    def code(self, language: Language) -> str:
        """Source of a Python class that needs NumPy and SciPy; there is no other language."""
        if language != "python":
            raise UserError("a predictive controller has code in Python only")
        names = [one.name for one in fields(self)]
        scalars = [n for n in names if not isinstance(getattr(self, n), np.ndarray)]
        rows, scaled = self.rows
        arrays = {n: getattr(self, n) for n in ("a", "b", "plan", "root")}
        arrays |= {"rows": rows, "scaled": scaled, "rest": self.rest}
        lines = [f"    {n} = {getattr(self, n)!r}" for n in sorted(scalars)]
        lines += [
            f"    {n} = np.array({value.tolist()}).reshape({value.shape})"
            for n, value in arrays.items()
        ]
        given = "\n".join(lines).replace("= inf", "= np.inf").replace("= -inf", "= -np.inf")
        return _CODE.format(given=given, about=self.about)


_CODE = '''import numpy as np
from scipy.optimize import nnls


class Controller:
    """{about}"""

{given}

    def __init__(self, u=u0):
        self.last, self.x = u, self.rest * (u - self.u0)

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


def _riccati(a: Array, b: Array, q: Array, r: float) -> Array:
    from scipy.linalg import solve_discrete_are

    eye = 1e-12 * (np.trace(q) + 1e-300) * np.eye(len(a))
    return np.asarray(solve_discrete_are(a, b, q + eye, np.array([[r]])), np.float64)


class _Synthesis:
    """Controllers of one plant: observers for several disturbances, regulators by weight."""

    def __init__(self, plant: ControlledPlant, pace: float) -> None:
        a, b, c = plant.a, plant.b, plant.c
        n = len(a)
        into, out = (max(float(np.linalg.norm(part)), 1e-300) for part in (b, c))
        whole = np.block([[a - np.eye(n), b / into], [c / out, np.zeros((1, 1))]])
        if np.linalg.cond(whole) > 1e12:
            raise UserError(
                "a constant input does not move the output: no controller with integral action "
                "holds a set point"
            )
        # States and input that hold the output 1.
        target = np.linalg.solve(whole, np.append(np.zeros(n), 1.0 / out))
        self.plant, self.rest, self.hold = plant, target[:n], float(target[n]) / into
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
            radius = spectral_radius(self.joint - self.joint @ gain @ self.row)
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
        radius = (
            max(spectral_radius(closed), min(self.observers, key=lambda one: one[0])[0]) ** 0.95
        )
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
        if not loop.sampling_time:
            settling = wanted.settling_max or loop.own_settling or 1.0
            loop = replace(loop, sampling_time=float(f"{settling / _SAMPLES:.1g}"))
        loop, none = loop.sampled(), np.zeros(0)
        base = SampledController(none, none, none, none, loop.sampling_time, loop.u0, loop.y0,
                                 limits.low, limits.high, limits.rate)  # fmt: skip
        return loop, *_design(loop, wanted, base, predictive, weights, moves)

    return designed


def _design(
    loop: Loop, wanted: Specification, base: SampledController, predictive: bool,
    weights: tuple[float, float] | None, moves: int | None,
) -> tuple[Design, list[LoopFigures], SampledController]:  # fmt: skip
    plants = [ControlledPlant.of(one) for one in loop.models]
    first = ControlledPlant.of(reduced(loop.models[0], tolerance=_NEGLIGIBLE).model)
    settling = wanted.settling_max or _SAMPLES * base.sampling_time
    synthesis = _Synthesis(first, 4.0 * base.sampling_time / settling)
    # The load asks for as much input as a unit step of the set point.
    load = synthesis.size**-0.5
    load = abs(synthesis.hold) if abs(synthesis.hold) > 1e-9 * load else load
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

    found = next((k for k, weight in enumerate(tracked(tried, "weight")) if meets(weight)), 0)
    if found:
        high, low = tried[found - 1], tried[found]
        for _ in tracked(range(_HALVINGS), "halving"):
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
