"""Controllers for control problems, designed on identified models of the plant.

    def design(models, context):
        return controllers.pid(models, context)

All designs minimise the cost of the problem in the training scenarios, simulated with the models:
the worst one counts. Limits of the inputs are part of every law, so nothing winds up. Sources:
Astrom and Hagglund, Advanced PID Control, 2006; Pannocchia and Rawlings, AIChE J. 49, 2003
(observer of a constant disturbance); Lawson and Hanson, Solving Least Squares Problems, chapter 23
(quadratic program); Silver et al., arXiv:1812.06298 (learned residual).
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from asia.candidate import Context, Controller, StepModel
from asia.data.trajectory import Array, Trajectory
from asia.lowering.linear import LinearModel
from asia.models._arrays import AnyArray, namespace
from asia.models._control.plant import (
    InputLimits,
    Law,
    PlantModel,
    first_row,
    plant_models,
    searched,
    task_of,
)

__all__ = ["LawController", "controlled", "lqr", "mpc", "paired", "pid", "relay", "with_residual"]

# A filter of the derivative this many times faster than its time.
_FILTER = 8.0
_DISTURBANCE = 1e-2
_MOVES = 20
# Longest experiment with a relay, in samples.
_RELAY = 3_000


# Running a controller.


@dataclass
class LawController:
    """Controller that runs one row of a law."""

    law: Law
    named: Mapping[str, float]
    """Parameters to report."""
    plants: Sequence[PlantModel] = ()
    """Models that it was designed on; they are not kept."""
    _state: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "plants": ()}

    def step(self, r: Array, y: Array) -> Array:
        """Inputs (nu,) from set points (nr,) and measured outputs (ny,)."""
        if self._state is None:
            self._state = self.law.start(y[None])
        self._state, u = self.law.step(self._state, r[None], y[None])
        return u[0]

    def parameters(self) -> dict[str, float]:
        """Parameters of the design."""
        return dict(self.named)


@dataclass(frozen=True)
class ControllerModel:
    """Controller as a worker asks it: a model from set points and outputs to inputs."""

    controller: Controller
    setpoints: int

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Raise TypeError: a controller answers one sample at a time."""
        raise TypeError("a controller answers one sample at a time")

    def initial(self, past_u: Array, past_y: Array, u: Array) -> list[Controller]:
        """Fresh copies of the controller."""
        del past_u, past_y
        return [copy.deepcopy(self.controller) for _ in u]

    def step(self, state: list[Controller], u: Array) -> tuple[list[Controller], Array]:
        """Ask the controllers for one sample."""
        n = self.setpoints
        answers = [c.step(row[:n].copy(), row[n:].copy()) for c, row in zip(state, u, strict=True)]
        return state, np.array([np.reshape(one, -1) for one in answers])

    def parameters(self) -> Mapping[str, float]:
        """Parameters that the controller offers."""
        offered = getattr(self.controller, "parameters", None)
        return cast("Mapping[str, float]", offered()) if callable(offered) else {}


def controlled(
    design: Callable[[Sequence[StepModel], Context], Controller],
    scenarios: Sequence[Trajectory],
    context: Context,
) -> ControllerModel:
    """Call a candidate's `design` with the identified models and the training scenarios.

    Raises:
        TypeError: where it returns something without `step`
    """
    task = task_of(context)
    models = [pickle.loads(one) for one in task.models]
    task = replace(task, models=(), scenarios=tuple(scenarios))
    found: Any = design(models, replace(context, control=task))
    if not callable(getattr(found, "step", None)):
        raise TypeError(f"design returned {type(found).__name__}, which has no step(r, y)")
    return ControllerModel(found, len(task.setpoints))


# Pairs of inputs and outputs.


def _operating_point(plants: Sequence[PlantModel], context: Context) -> tuple[Array, Array]:
    """Middle of the set points (nr,), and the inputs (nu,) that hold it."""
    middle = np.array([0.5 * (low + high) for low, high in task_of(context).ranges])
    return middle, plants[0].inputs_at(middle)


def _pairs(gain: Array) -> list[int]:
    """Input of each controlled output, by relative gains nearest to 1 (Bristol, 1966).

    Args:
        gain: static gains (nr, nu) over the ranges
    """
    from scipy.optimize import linear_sum_assignment

    relative = gain * np.linalg.pinv(gain).T
    _, columns = linear_sum_assignment(np.abs(relative - 1.0))
    return [int(c) for c in columns]


@dataclass(frozen=True)
class _Basis:
    """Linear model at the operating point, set points and inputs there, and pairs."""

    linear: LinearModel
    r: Array
    u: Array
    inverse: Array
    """Change of the inputs by that of the set points at rest (nu, nr)."""
    inputs: list[int]
    """Input of each controlled output."""
    select: Array
    """1 where an input belongs to a controlled output (nr, nu)."""
    gain: Array
    """Static gain of each pair (nr,)."""
    pace: float
    """Slowest time constant in samples."""


def _basis(plants: Sequence[PlantModel], context: Context) -> _Basis:
    r, u = _operating_point(plants, context)
    linear = plants[0].linear_at(u)
    gain = np.asarray(linear.gain)[list(task_of(context).controlled)]
    inputs = _pairs(gain)
    size = float(np.clip(np.abs(linear.poles).max(), 0.1, 0.9995))
    pair = gain[np.arange(len(inputs)), inputs]
    select = np.eye(gain.shape[1])[inputs]
    inverse = np.asarray(np.linalg.pinv(gain), np.float64)
    pace = -1.0 / np.log(size)
    return _Basis(linear, r, u, inverse, inputs, select, pair, float(pace))


# PID.


@dataclass(frozen=True)
class _PidLaw:
    """PID loops of paired outputs, with a linear feedforward of the set points.

    theta (rows, 4 nr or 6 nr): for each loop logarithms of gain, integral time and derivative time
    in units of the plant's, the share of the feedforward; where they are scheduled, the slopes of
    the first two over the range of the set point.
    """

    theta: Array
    basis: _Basis
    limits: InputLimits
    controlled: list[int]
    half: Array
    """Half of the range of each set point."""

    @property
    def rows(self) -> tuple[Array, ...]:
        """`theta`."""
        return (self.theta,)

    def with_rows(self, rows: tuple[AnyArray, ...]) -> _PidLaw:
        """Return the law with another `theta`."""
        return replace(self, theta=rows[0])

    def start(self, y: AnyArray) -> Any:
        """Integrals, filtered outputs and last inputs."""
        y = y[:, self.controlled]
        return 0.0 * y, y, namespace(y).tile(self.limits.start, (len(y), 1))

    def step(self, state: Any, r: AnyArray, y: AnyArray) -> tuple[Any, AnyArray]:
        """Advance one sample."""
        integral, filtered, last = state
        xp, nr, of = namespace(y, self.theta), len(self.controlled), self.basis
        theta = self.theta.reshape(len(self.theta), nr, -1)
        y = y[:, self.controlled]
        k, ti = theta[:, :, 0], theta[:, :, 1]
        if theta.shape[2] > 4:
            place = xp.clip((r - of.r) / self.half, -1.5, 1.5)
            k, ti = k + theta[:, :, 4] * place, ti + theta[:, :, 5] * place
        k, ti = xp.exp(k) / of.gain, xp.exp(ti) * of.pace
        td = xp.exp(theta[:, :, 2]) * of.pace
        moved = filtered + (y - filtered) / (1.0 + td / _FILTER)
        error = r - y
        loop = k * (error - td * (moved - filtered)) + integral
        wanted = of.u + (theta[:, :, 3] * (r - of.r)) @ of.inverse.T + loop @ of.select
        u = self.limits(wanted, last)
        # Back-calculation with the mean of integral and derivative time, at least a sample.
        track = xp.maximum(xp.sqrt(ti * xp.maximum(td, 1.0)), 1.0)
        integral = integral + k * error / ti + ((u - wanted) @ of.select.T) / track
        return (integral, moved, u), u


def pid(
    models: Sequence[StepModel],
    context: Context,
    *,
    scheduled: bool = False,
    generations: int = 20,
    population: int = 32,
) -> LawController:
    """PID loops with anti-windup, derivative filter and feedforward, optimised together.

    Args:
        scheduled: whether gains and integral times follow the set point.
        generations, population: of the optimisation.
    """
    plants = plant_models(models, context)
    make = _pid_maker(plants, context)
    nr = len(task_of(context).setpoints)
    each = [(-3.0, 4.5), (-4.0, 2.0), (-6.0, 0.0), (0.0, 1.0)]
    each += [(-1.0, 1.0), (-1.0, 1.0)] if scheduled else []
    theta = searched(plants, make, each * nr, context, generations=generations,
                     population=population)  # fmt: skip
    names = ["log gain", "log integral time", "log derivative time", "feedforward"]
    names += ["gain slope", "integral slope"] if scheduled else []
    outputs = task_of(context).setpoints
    named = {f"{name} {o}"[:48]: float(v) for (o, name), v in
             zip([(o, n) for o in outputs for n in names], theta, strict=True)}  # fmt: skip
    return LawController(make(theta[None]), named, plants)


def _pid_maker(plants: Sequence[PlantModel], context: Context) -> Callable[[Array], _PidLaw]:
    task = task_of(context)
    half = np.array([0.5 * (high - low) or 1.0 for low, high in task.ranges])
    return partial(
        _PidLaw, basis=_basis(plants, context), limits=InputLimits.of(context),
        controlled=list(task.controlled), half=half,
    )  # fmt: skip


def relay(models: Sequence[StepModel], context: Context) -> LawController:
    """PID loops tuned by the oscillation under a relay on the first model (Astrom and Hagglund,
    Automatica 20, 1984), with the settings of Tyreus and Luyben (Ind. Eng. Chem. Res. 31, 1992)."""
    plants = plant_models(models, context)
    make = _pid_maker(plants, context)
    basis, task = make(np.zeros((1, 0))).basis, task_of(context)
    span = InputLimits.of(context).high - InputLimits.of(context).low
    theta: list[float] = []
    for place, column, gain in zip(task.controlled, basis.inputs, basis.gain, strict=True):
        size = 0.1 * float(span[column])
        ultimate, period = _oscillation(
            plants[0], basis.u, column, place, size * np.sign(gain), 2.0 * task.noise[place]
        )
        times = 2.2 * period / basis.pace, period / 6.3 / basis.pace
        theta += [np.log(max(ultimate * abs(gain) / 2.2, 1e-6)), *np.log(times), 0.0]
    return LawController(make(np.array([theta])), {})


def _oscillation(
    plant: PlantModel, u: Array, column: int, place: int, size: float, band: float
) -> tuple[float, float]:
    """Ultimate gain and period in samples of one loop under a relay with hysteresis."""
    state, y = plant.settle(u[None])
    state = first_row(state)
    target, up, seen = float(y[0, place]), True, list[float]()
    switches: list[int] = []
    for k in range(_RELAY):
        error = target - float(y[0, place])
        if (up and error < -band) or (not up and error > band):
            up = not up
            switches.append(k)
        given = u.copy()
        given[column] += size if up else -size
        state, y = plant.model.step(state, given[None])
        seen.append(float(y[0, place]))
        if len(switches) >= 12:
            break
    if len(switches) < 6:
        raise ValueError("controllers: the loop does not oscillate under a relay")
    period = 2.0 * float(np.mean(np.diff(switches[-6:])))
    part = np.array(seen[switches[-5] :])
    amplitude = max(0.5 * float(np.ptp(part)), 1e-300)
    return 4.0 * abs(size) / (np.pi * amplitude), period


# Loops tuned one by one by a function of the caller's.


@dataclass(frozen=True)
class Pair:
    """Operating point and limits of one loop."""

    u0: float
    y0: float
    low: float
    high: float
    rate: float


@dataclass
class PairedController:
    """Single-loop controllers, each of which has `step(x, last, r, y)` and a state of `len(c)`."""

    loops: Sequence[Any]
    inputs: Sequence[int]
    controlled: Sequence[int]
    last: Array
    states: list[Array]

    def step(self, r: Array, y: Array) -> Array:
        """Inputs (nu,) from set points and outputs."""
        for k, (loop, column, place) in enumerate(
            zip(self.loops, self.inputs, self.controlled, strict=True)
        ):
            self.states[k], self.last[column] = loop.step(
                self.states[k], float(self.last[column]), float(r[k]), float(y[place])
            )
        return self.last.copy()


def paired(
    models: Sequence[StepModel],
    context: Context,
    tune: Callable[[Sequence[LinearModel], Pair], Any],
) -> PairedController:
    """Pair outputs and inputs, and tune each loop for the linear models at the operating point."""
    plants, task, limits = plant_models(models, context), task_of(context), InputLimits.of(context)
    basis = _basis(plants, context)
    linear = [basis.linear, *(one.linear_at(basis.u) for one in plants[1:])]
    loops: list[Any] = []
    for place, column in zip(task.controlled, basis.inputs, strict=True):
        single = [
            replace(one, b=one.b[:, [column]], c=one.c[[place]], d=one.d[[place]][:, [column]])
            for one in linear
        ]
        actuator = task.actuators[column]
        pair = Pair(float(basis.u[column]), float(basis.linear.y0[place]), actuator.min,
                    actuator.max, actuator.rate)  # fmt: skip
        loops.append(tune(single, pair))
    return PairedController(
        loops, basis.inputs, task.controlled, limits.start.copy(),
        [np.zeros(len(loop.c)) for loop in loops],
    )  # fmt: skip


# LQR and MPC.


@dataclass(frozen=True)
class _FeedbackLaw:
    """State feedback on estimates of the states and of constant disturbances of the outputs.

    It gives changes of the inputs: x[k+1] = A x + B u, y = C x + d, and the cost is that of the
    problem, with the changes weighted by exp(theta[0]) and the observer by exp(theta[1]).
    """

    gains: Array
    """Feedback from deviations of x and u (rows, nu, n + nu)."""
    estimates: Array
    """Correction of x and d by an output error (rows, n + ny, ny)."""
    linear: LinearModel
    target: Array
    """Rest (n + nu, nr) by the deviation of r - d."""
    limits: InputLimits
    controlled: list[int]
    r: Array

    @property
    def rows(self) -> tuple[Array, ...]:
        """Feedback and corrections."""
        return self.gains, self.estimates

    def with_rows(self, rows: tuple[AnyArray, ...]) -> _FeedbackLaw:
        """Return the law with other feedback and corrections."""
        return replace(self, gains=rows[0], estimates=rows[1])

    def start(self, y: AnyArray) -> Any:
        """Estimates and last inputs: at rest, where the outputs tell the disturbances."""
        xp, of = namespace(y), self.linear
        rest = np.linalg.solve(np.eye(of.order) - of.a, of.b @ (self.limits.start - of.u0))
        d = y - of.y0 - of.c @ rest
        x = xp.tile(rest, (len(y), 1))
        return xp.concatenate([x, d], axis=1), xp.tile(self.limits.start, (len(y), 1))

    def step(self, state: Any, r: AnyArray, y: AnyArray) -> tuple[Any, AnyArray]:
        """Advance one sample."""
        (known, last), of = state, self.linear
        xp, n = namespace(y, known), of.order
        error = y - of.y0 - known[:, :n] @ of.c.T - known[:, n:]
        known = known + xp.einsum("bij,bj->bi", self.estimates, error)
        x, d = known[:, :n], known[:, n:]
        rest = (r - of.y0[self.controlled] - d[:, self.controlled]) @ self.target.T
        u = self.moved(x, last, rest)
        x = x @ of.a.T + (u - of.u0) @ of.b.T
        return (xp.concatenate([x, d], axis=1), u), u

    def moved(self, x: AnyArray, last: AnyArray, rest: AnyArray) -> AnyArray:
        """Inputs (rows, nu) within the limits."""
        xp = namespace(x)
        away = xp.concatenate([x, last - self.linear.u0], axis=1) - rest
        return self.limits(last - xp.einsum("bij,bj->bi", self.gains, away), last)


def _feedback_maker(
    plants: Sequence[PlantModel], context: Context
) -> Callable[[Array], _FeedbackLaw]:
    from scipy.linalg import solve_discrete_are

    task, basis = task_of(context), _basis(plants, context)
    of, places, limits = basis.linear, list(task.controlled), InputLimits.of(context)
    n, nu, ny = of.order, len(of.u0), len(of.y0)
    tolerance = np.array(task.tolerance)
    whole = np.block([[of.a - np.eye(n), of.b], [of.c[places], np.zeros((len(places), nu))]])
    target = np.asarray(np.linalg.pinv(whole)[:, n:], np.float64)
    a = np.block([[of.a, of.b], [np.zeros((nu, n)), np.eye(nu)]])
    b = np.vstack([of.b, np.eye(nu)])
    c = np.hstack([of.c[places], np.zeros((len(places), nu))]) / tolerance[: len(places), None]
    joint = np.block([[of.a, np.zeros((n, ny))], [np.zeros((ny, n)), np.eye(ny)]])
    row = np.hstack([of.c, np.eye(ny)])
    spread = np.concatenate([r.y for r in task.records]).std(axis=0)
    noise = np.diag(np.maximum(np.array(task.noise), 1e-3 * spread) ** 2)
    drive = np.vstack([of.b * (limits.high - limits.low), np.zeros((ny, nu))])

    def solved(theta: Array) -> tuple[Array, Array]:
        weight = np.diag(np.exp(theta[0]) / tolerance[len(places) :] ** 2)
        p = solve_discrete_are(a, b, c.T @ c + 1e-9 * np.eye(n + nu), weight)
        gain = np.linalg.solve(weight + b.T @ p @ b, b.T @ p @ a)
        walk = np.zeros((n + ny, n + ny))
        walk[n:, n:] = np.diag(spread**2) * np.exp(theta[1])
        q = _DISTURBANCE * np.exp(theta[1]) * drive @ drive.T + walk + 1e-12 * np.eye(n + ny)
        s = solve_discrete_are(joint.T, row.T, q, noise)
        correction = np.linalg.solve(row @ s @ row.T + noise, row @ s).T
        return np.asarray(gain, np.float64), np.asarray(correction, np.float64)

    def make(theta: Array) -> _FeedbackLaw:
        different, where = np.unique(theta, axis=0, return_inverse=True)
        gains, corrections = list[Array](), list[Array]()
        for one in different:
            try:
                gain, correction = solved(one)
            except (np.linalg.LinAlgError, ValueError):
                gain, correction = np.zeros((nu, n + nu)), np.zeros((n + ny, ny))
            gains.append(gain)
            corrections.append(correction)
        where = where.reshape(-1)
        return _FeedbackLaw(
            np.stack(gains)[where], np.stack(corrections)[where], of, target, limits, places,
            basis.r,
        )  # fmt: skip

    return make


def lqr(
    models: Sequence[StepModel], context: Context, *, generations: int = 10, population: int = 16
) -> LawController:
    """Linear quadratic regulator with an observer of constant disturbances; the weight of the
    input changes and the speed of the observer are optimised in simulation."""
    plants = plant_models(models, context)
    make = _feedback_maker(plants, context)
    bounds = [(-6.0, 6.0), (-18.0, 2.0)]
    theta = searched(plants, make, bounds, context, generations=generations,
                     population=population)  # fmt: skip
    named = {"log input weight": float(theta[0]), "log observer noise": float(theta[1])}
    return LawController(make(theta[None]), named, plants)


@dataclass(frozen=True)
class _PredictiveLaw(_FeedbackLaw):
    """State feedback whose next moves are planned within the limits."""

    plan: Array
    """Next N changes of the inputs without limits by deviations of x and u (N nu, n + nu)."""
    root: Array
    """Upper triangular; its square is the Hessian of the cost of the plan."""

    def moved(self, x: Array, last: Array, rest: Array) -> Array:
        """First inputs of the plans."""
        away = np.concatenate([x, last - self.linear.u0], axis=1) - rest
        found = [self._planned(one, before) for one, before in zip(away, last, strict=True)]
        return self.limits(np.stack(found), last)

    def _planned(self, away: Array, last: Array) -> Array:
        from scipy.optimize import nnls

        nu, of = len(last), self.limits
        plan = -self.plan @ away
        moves = len(plan) // nu
        total = np.kron(np.tril(np.ones((moves, moves))), np.eye(nu))
        sides = [(total, np.tile(of.low - last, moves)), (-total, np.tile(last - of.high, moves))]
        if np.isfinite(of.most).all():
            eye, most = np.eye(len(plan)), np.tile(-of.most, moves)
            sides += [(eye, most), (-eye, most)]
        rows = np.vstack([one for one, _ in sides])
        h = np.concatenate([side for _, side in sides]) - rows @ plan
        size = float(h.max())
        if size <= 1e-12:
            return last + plan[:nu]
        scaled = np.linalg.solve(self.root.T, rows.T)
        matrix = np.vstack([scaled, h / size])
        aim = np.append(np.zeros(len(plan)), 1.0)
        try:
            left = aim - matrix @ nnls(matrix, aim)[0]
        except RuntimeError:
            return last + plan[:nu]
        moved = np.linalg.solve(self.root, size * left[:-1] / -max(left[-1], 1e-12))
        return last + plan[:nu] + moved[:nu]


def mpc(
    models: Sequence[StepModel], context: Context, *, moves: int = _MOVES, generations: int = 10,
    population: int = 16,
) -> LawController:  # fmt: skip
    """Predictive controller: the regulator of `lqr`, whose next moves are planned within the limits
    in each sample by a quadratic program."""
    found = lqr(models, context, generations=generations, population=population)
    law = found.law
    assert isinstance(law, _FeedbackLaw)
    of, tolerance = law.linear, np.array(task_of(context).tolerance)
    n, nu, places = of.order, len(of.u0), law.controlled
    a = np.block([[of.a, of.b], [np.zeros((nu, n)), np.eye(nu)]])
    b = np.vstack([of.b, np.eye(nu)])
    c = np.hstack([of.c[places], np.zeros((len(places), nu))]) / tolerance[: len(places), None]
    weight = np.diag(np.exp(found.named["log input weight"]) / tolerance[len(places) :] ** 2)
    gain = law.gains[0]
    closed, power, plan = a - b @ gain, np.eye(n + nu), list[Array]()
    from scipy.linalg import solve_discrete_lyapunov

    # Cost to go of the regulator.
    end = solve_discrete_lyapunov(closed.T, c.T @ c + gain.T @ weight @ gain)
    moved, cost = np.zeros((n + nu, moves * nu)), np.kron(np.eye(moves), weight)
    for k in range(moves):
        plan.append(gain @ power)
        power = closed @ power
        moved = a @ moved
        moved[:, k * nu : (k + 1) * nu] += b
        cost += moved.T @ (end if k == moves - 1 else c.T @ c) @ moved
    root = np.linalg.cholesky(cost + 1e-12 * np.trace(cost) * np.eye(len(cost))).T
    values = {name: getattr(law, name) for name in _FeedbackLaw.__dataclass_fields__}
    law = _PredictiveLaw(**values, plan=np.vstack(plan), root=np.asarray(root, np.float64))
    return LawController(law, {**found.named, "moves": float(moves)}, found.plants)


# Learned residual.


@dataclass(frozen=True)
class _ResidualLaw:
    """Law plus a small network of errors, integral of errors, set points and outputs."""

    base: Law
    theta: Array
    """Weights (rows, n) of one hidden layer."""
    hidden: int
    limits: InputLimits
    controlled: list[int]
    center: Array
    half: Array
    tolerance: Array

    @property
    def rows(self) -> tuple[Array, ...]:
        """`theta`."""
        return (self.theta,)

    def with_rows(self, rows: tuple[AnyArray, ...]) -> _ResidualLaw:
        """Return the law with other weights."""
        return replace(self, theta=rows[0])

    def start(self, y: AnyArray) -> Any:
        """State of the base, leaky integrals of the errors, and the last errors."""
        nothing = 0.0 * y[:, self.controlled]
        return self.base.start(y), nothing, nothing

    def step(self, state: Any, r: AnyArray, y: AnyArray) -> tuple[Any, AnyArray]:
        """Advance one sample."""
        inner, integral, before = state
        xp = namespace(y, self.theta)
        inner, u = self.base.step(inner, r, y)
        error = (r - y[:, self.controlled]) / self.tolerance
        place = (y[:, self.controlled] - self.center) / self.half
        seen = xp.concatenate([error / 3.0, integral / 3.0, error - before, place], axis=1)
        wide, nu = seen.shape[1], u.shape[1]
        first = self.theta[:, : wide * self.hidden].reshape(-1, wide, self.hidden)
        last = self.theta[:, wide * self.hidden :].reshape(-1, self.hidden, nu)
        inside = xp.tanh(xp.einsum("bi,bij->bj", xp.tanh(seen), first))
        change = xp.einsum("bi,bij->bj", inside, last) * 0.1 * (self.limits.high - self.limits.low)
        return (inner, 0.95 * integral + 0.05 * error, error), u + change


def with_residual(
    base: LawController, context: Context, *, hidden: int = 3, generations: int = 40,
    population: int = 40,
) -> LawController:  # fmt: skip
    """A controller plus a learned residual: a small network of errors and outputs adds at most a
    tenth of the input range per neuron. Zero weights, the controller itself, are the start."""
    task, limits = task_of(context), InputLimits.of(context)
    nr, nu = len(task.setpoints), len(limits.low)
    ranges = np.array(task.ranges)

    def make(theta: Array) -> _ResidualLaw:
        return _ResidualLaw(
            base.law, theta, hidden, limits, list(task.controlled), ranges.mean(axis=1),
            np.array([0.5 * (high - low) or 1.0 for low, high in ranges]),
            np.array(task.tolerance)[:nr],
        )  # fmt: skip

    count = 4 * nr * hidden + hidden * nu
    theta = searched(
        base.plants, make, [(-2.0, 2.0)] * count, context, generations=generations,
        population=population, near=0.1,
    )  # fmt: skip
    named = {**base.named, "residual weights": float(count)}
    return LawController(make(theta[None]), named, base.plants)
