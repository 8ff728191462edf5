"""Linear state-space model: subspace start, then refinement of the simulation error, with that of
measured frequency responses where the problem has some.

x[k+1] = A x[k] + B u[k - delay],  y[k] = C x[k] + D u[k - delay] + offset, with the initial state
estimated from the past window. With a horizon, a model whose state is the past window itself
competes. Source: Ljung, System Identification, 2nd ed., chapters 4 and 10.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from asia._progress import tracked
from asia.candidate import Context, ParameterEstimate, ParameterEstimates
from asia.data.process import ROUNDING
from asia.data.trajectory import MOST_DELAY, Array, Trajectory
from asia.models._arrays import AnyArray, namespace
from asia.models._config import check_at_least, check_choice, demand
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear import fit as levels
from asia.models._linear.closed_loop import LoopMethod, fit_in_loop
from asia.models._linear.fit import (
    LinearFit,
    Refinement,
    drift_shift,
    encoder_of,
    fit,
    invariants,
    refined_under_noise,
    system_estimates,
    unseen_errors,
)
from asia.models._linear.joint import fit_jointly, sampled_responses
from asia.models._linear.periodic import fit_periodic
from asia.models._linear.regularised import Form, fit_regularised
from asia.models._linear.response import numbers_of
from asia.models._linear.system import LinearSystem
from asia.models._linear.window_predictor import (
    MOST_WINDOWS,
    WindowPredictor,
    choose,
    fit_choice,
    held_out,
    window_error,
)
from asia.models._noise.model import refuse_noise
from asia.models._numerics.encoder import Encoder
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import (
    ScaledData,
    ScaledTrajectory,
    check,
    cut_windows,
    delayed_inputs,
    flat_past,
    past_length,
    scaled,
    shortened,
    stretches,
)
from asia.models._reuse import reused
from asia.models._steps import TrainableModel, first_of_line, through_line

# Samples for the choice of order and delay, which takes dozens of fits; this many distinguish
# candidates.
_SELECTION_SAMPLES = 3000
# Greatest number of outputs for which a state-space model competes with the windowed one; with more
# it has too many parameters for simulations of whole records.
_MOST_OUTPUTS = 3
_JACOBIAN_NUMBERS = 60_000_000
# Greatest number of parameters that a candidate may report.
_MOST_PARAMETERS = 64


@dataclass(frozen=True)
class Config:
    """Order and delay of the system, or limits of their choice. Frequency responses of the problem
    count beside the records, except with a noise model, `periodic`, `levels`, `regularised` and
    `loop`."""

    order: int | None = None
    """States; None chooses among 1..max_order by the simulation error on blocks inside the training
    data."""
    max_order: int = 6
    """Greatest order tried where `order` is None."""
    tolerance: float = 0.03
    """The smallest order whose error is within this share of the least is taken."""
    delay: int | None = 0
    """Samples by which every input is delayed beyond what the states can express; None estimates
    it among 0..10."""
    integrators: int = 0
    """Free integrators: poles held at 1, which count among the states."""
    periodic: bool = False
    """Fit records with periodic inputs in steady state line by line, where whole
    records are simulated, without free integrators and noise model: all realisations at once,
    systems of many states in seconds. A delay of None is then left to the states."""
    periodic_order: int = 60
    """Greatest order tried by `periodic` where `order` is None."""
    levels: bool = False
    """Fit separate systems to records whose inputs differ in size; a simulation interpolates
    between their outputs by the root mean square of its inputs so far."""
    regularised: Form | None = None
    """Estimate the coefficients of a long impulse response ("response") or difference equation
    ("equation") with a prior that decays with the lag, and reduce the model to `order` states, or
    to as many as matter. Where whole records are simulated, without a noise model; an unstable
    equation is left for the usual fit."""
    loop: LoopMethod | None = None
    """Method for records taken under feedback: "direct" models the noise, "two_stage" uses the
    measured reference, "controller" simulates the loop with the known controller. None treats the
    records as open loop. Plants may be unstable."""

    def __post_init__(self) -> None:
        check_choice(self, "loop", (None, *get_args(LoopMethod)))
        check_choice(self, "regularised", (None, *get_args(Form)))
        alone = not (self.integrators or self.periodic or self.levels)
        demand(self, "loop", alone or not self.loop, "None beside integrators, periodic and levels")
        alone = alone and not self.loop
        demand(
            self, "regularised", alone or not self.regularised,
            "None beside integrators, periodic, levels and loop",
        )  # fmt: skip
        check_at_least(1, self, "order", "max_order", "periodic_order")
        check_at_least(0, self, "delay", "integrators")
        enough = self.integrators <= (self.order or self.max_order)
        demand(self, "integrators", enough, "at most the order")


@dataclass(frozen=True)
class FittedLinear:
    """Result of training a linear model."""

    system: LinearSystem
    """System for z-scored signals."""
    encoder: Encoder
    """Map from the past window to the initial state."""
    delay: int
    """Delay of the inputs, in samples."""
    scaling: Scaling
    """Scaling from physical units to z-scores."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units, block by block."""
        x0 = self.encoder(flat_past(self.scaling.inputs(past_u), self.scaling.outputs(past_y)))

        def late(first: int, stop: int) -> Array:
            return delayed_inputs(self.scaling, self.delay, past_u, u, first, stop)

        return self.scaling.physical(self.system.outputs(x0, late, u.shape[1]))

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """States, and the inputs that the delay holds back."""
        past, first = self.scaling.inputs(past_u), self.scaling.inputs(u)
        x = self.encoder(flat_past(past, self.scaling.outputs(past_y)))
        return x, first_of_line(past, first, self.delay)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by x' = A x + B u, y = C x + D u + offset."""
        s, (x, line) = self.system, state
        line, v = through_line(line, self.scaling.inputs(u))
        y = x @ s.c.T + v @ s.d.T + s.offset
        return (x @ s.a.T + v @ s.b.T, line), self.scaling.physical(y)

    def parameters(self) -> dict[str, float]:
        """Static gains in physical units, order, delay and slowest modes, times in samples."""
        chosen = {"order [states]": float(self.system.order), "delay [samples]": float(self.delay)}
        return invariants(self.system, self.scaling) | chosen


@dataclass(frozen=True)
class FittedLevels:
    """Systems for levels of excitation."""

    systems: tuple[FittedLinear, ...]
    """Fitted systems, one a level, all of one scaling."""
    levels: Array
    """Root mean squares of the scaled inputs (L,), rising."""
    memory: int
    """Number of samples of the inputs that give the level."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units."""
        scaling = self.systems[0].scaling
        each = np.stack([f.simulate(past_u, past_y, u) for f in self.systems])
        past, future = scaling.inputs(past_u), scaling.inputs(u)
        return levels.interpolated(self.levels, each, past, future, self.memory)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """State of each system, the power of the last `memory` inputs, and their number."""
        xp, memory = namespace(past_u, past_y, u), self.memory
        power = (self.systems[0].scaling.inputs(past_u)[:, -memory:] ** 2).mean(axis=2)
        batch, length = power.shape
        held = xp.concatenate([xp.zeros((batch, memory - length)), power], axis=1)
        states = [one.initial(past_u, past_y, u) for one in self.systems]
        return states, held, xp.full((batch,), float(length))

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; outputs of the systems are weighted by the running level of the
        inputs."""
        xp, (states, held, count) = namespace(u), state
        power = (self.systems[0].scaling.inputs(u) ** 2).mean(axis=1)
        held = xp.concatenate([held[:, 1:], power[:, None]], axis=1)
        count = xp.minimum(count + 1.0, float(self.memory))
        weights = levels.shares(self.levels, xp.sqrt(xp.maximum(held.sum(axis=1), 0.0) / count))
        pairs = [one.step(x, u) for one, x in zip(self.systems, states, strict=True)]
        total = sum(weights[:, i, None] * y for i, (_, y) in enumerate(pairs))
        return ([x for x, _ in pairs], held, count), total


@dataclass(frozen=True)
class LinearStateSpace(TrainableModel[Config, FittedLinear | FittedLevels]):
    """Linear model; before training `fitted` and `by_level` are None, after it one of them.

    Before a past window that is shorter than the delay the input is held at the window's first
    value.
    """

    label = "linear model"
    fitted: FittedLinear | None = None
    by_level: FittedLevels | None = None

    def parameters(self) -> dict[str, float]:
        """Static gains in physical units; order, delay and slowest time constants in samples.

        These quantities do not depend on the coordinates of the states, so that folds can be
        compared.

        Raises:
            UserError: before training.
        """
        found = self._trained()
        if isinstance(found, FittedLinear):
            return found.parameters()
        each = enumerate((one.parameters() for one in found.systems), 1)
        named = [(f"{name}, level {k}", v) for k, p in each for name, v in p.items()]
        return dict(named[:_MOST_PARAMETERS])

    def estimates(self, trajectories: Sequence[Trajectory], context: Context) -> ParameterEstimates:
        """Gains and modes with their standard errors, given the records of the fit.

        Raises:
            UserError: before training.
            ValueError: for free integrators, many states, and a fit that is no minimum of the
                simulation error: one under a noise model, or over windows.
        """
        f = self._trained()
        if isinstance(f, FittedLevels):
            raise ValueError("linear model: gains and time constants differ from level to level")
        if context.responses:
            raise ValueError("linear model: fitted to frequency responses beside the records")
        if self.config.integrators:
            raise ValueError("linear model: with free integrators there are no static gains")
        units = {
            f"gain y{i + 1}/u{j + 1}": f"{y.unit}/{u.unit}" if y.unit or u.unit else ""
            for i, y in enumerate(context.outputs)
            for j, u in enumerate(context.inputs)
        }
        # Without the samples whose delayed input was not measured.
        every = scaled(trajectories, f.scaling)
        records = [r.with_delay(f.delay).part(f.delay, len(r)) for r in every]

        def report(system: LinearSystem) -> list[ParameterEstimate]:
            found = invariants(system, f.scaling).items()
            rest = float("nan"), float("nan"), float("nan")
            # Time constants and frequencies are positive.
            return [
                ParameterEstimate(
                    n, v, *rest, units.get(n, ""),
                    lower=np.finfo(float).tiny if n.endswith("]") else -np.inf,
                )
                for n, v in found
            ]  # fmt: skip

        return system_estimates(f.system, records, report)

    def _trained(self) -> FittedLinear | FittedLevels:
        return self.by_level or super()._trained()


build = LinearStateSpace.build


def train(
    model: LinearStateSpace,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt | None = None,
) -> LinearStateSpace:
    """Fit to the simulation error of all records at once.

    Args:
        model: untrained model.
        trajectories: training records.
        context: context of the fit.
        method: iterations, damping, tolerance and the noise model; None for the defaults.

    Raises:
        UserError: for records too short or with the wrong channels.
    """
    check(trajectories, context)
    scaling = scaling_of(trajectories, context, model.config)
    records = scaled(trajectories, scaling)
    refinement, c = Refinement.of(method), model.config
    if c.loop is not None:
        refuse_noise(method or LevenbergMarquardt(), f"linear, loop={c.loop!r}")
        # The controller answers in the same sample: a predictor takes that for the plant.
        choices = replace(c, delay=None) if c.loop == "direct" and c.delay == 0 else c
        parts = fit_in_loop(trajectories, context, c.loop, choices, refinement, scaling)
        return replace(model, fitted=FittedLinear(*parts))
    if c.levels:
        context = replace(context, responses=())
    groups = levels.groups_by_level([r.u for r in records]) if model.config.levels else []
    if len(groups) < 2:
        fitted = _fitted(records, context, model.config, refinement, scaling)
        return replace(model, fitted=fitted)
    parts = [[records[i] for i in group] for group in groups]
    systems = tuple(_fitted(part, context, model.config, refinement, scaling) for part in parts)
    each = np.array([levels.level_of(np.concatenate([r.u for r in part])) for part in parts])
    by_level = FittedLevels(systems, each, max(len(r) for r in records))
    return replace(model, by_level=by_level)


def _fitted(
    records: ScaledData, context: Context, config: Config, refinement: Refinement, scaling: Scaling
) -> FittedLinear:
    plain = context.horizon is None and config.integrators == 0 and refinement.noise is None
    if config.periodic and plain:
        late = [r.with_delay(config.delay or 0) for r in records]
        periodic = fit_periodic(late, context, config, refinement.iterations, context.log)
        if periodic is not None:
            return FittedLinear(*periodic, config.delay or 0, scaling)
    if config.regularised and plain:
        late = [r.with_delay(config.delay or 0) for r in records]
        found = fit_regularised(late, context, config.regularised, config.order)
        if found is not None:
            return FittedLinear(*found, config.delay or 0, scaling)
    if context.responses and refinement.noise is None:
        found, delay, used = _fit_with_responses(records, context, config, refinement, scaling)
        return FittedLinear(found.system, encoder_of(used, found, context), delay, scaling)
    predictor = windowed(records, context, config, refinement)
    if predictor is not None:
        return FittedLinear(*predictor.system(), 0, scaling)
    found, delay, used = fit_records(records, context, config, refinement)
    return FittedLinear(found.system, encoder_of(used, found, context), delay, scaling)


def scaling_of(trajectories: Sequence[Trajectory], context: Context, config: Config) -> Scaling:
    """Scaling to z-scores; with free integrators zero is the input at which these are at rest."""
    plain = Scaling.of(trajectories)
    if not config.integrators:
        return plain
    part = _selection(scaled(trajectories, plain), context, config)
    shift = drift_shift(part, config.order or 2, config.integrators)
    return replace(plain, u_mean=plain.u_mean - shift * plain.u_std)


def windowed(
    records: ScaledData, context: Context, config: Config, refinement: Refinement
) -> WindowPredictor | None:
    """Fit the model whose state is the past window, for a horizon and an open order.

    Returns:
        None where the state-space model has the smaller error on windows left out, and with a noise
        model: the past window is full of noise.
    """
    known = config.order is not None or config.integrators > 0
    if context.horizon is None or known or refinement.noise is not None:
        return None
    choice = choose(records, context, refinement)
    if choice is None:
        return None
    if context.ny <= _MOST_OUTPUTS:
        part = _selection(records, context, config)
        order = fit_records(part, context, config, refinement)[0].system.order
        known = replace(config, order=order)
        errors: list[float] = []
        for kept, left in held_out(part, context):
            found, delay, used = fit_records(kept, context, known, refinement)
            cut = cut_windows([r.with_delay(delay) for r in left], context, MOST_WINDOWS)
            errors.append(window_error(found.system, encoder_of(used, found, context), cut))
        if np.mean(errors) < choice.error:
            return None
    predictor = fit_choice(records, context, choice, refinement)
    context.log(0, float(np.sqrt(choice.error)))
    return predictor


@dataclass(frozen=True)
class Selection:
    """Order and delay of a linear model, with the errors that decide."""

    order: int
    delay: int
    """Samples by which the inputs are delayed beyond what the states express."""
    order_errors: dict[int, float]
    """Simulation error on held-out segments, in z-scores, by order; empty for a given order."""
    delay_errors: dict[int, float]
    """Simulation error of a model of modest order, in z-scores, by delay; empty for a given one."""


def select(
    records: ScaledData, context: Context, config: Config, refinement: Refinement
) -> Selection:
    """Choose delay and order on part of the records: the smallest delay within 1 % of the least
    error, and the smallest order whose error is within the tolerance of the least."""
    part = _selection(records, context, config)
    time = context.sampling_time, context.n_past_u, context.n_past_y, context.horizon
    return reused(
        "selection",
        (part, time, config, refinement),
        lambda _: _selected(part, context, config, refinement),
        context.log,
    )


def _selected(
    part: ScaledData, context: Context, config: Config, refinement: Refinement
) -> Selection:
    delay, order, held = config.delay, config.order, config.integrators
    delay_errors: dict[int, float] = {}
    order_errors: dict[int, float] = {}
    rounding = ROUNDING**0.5
    if delay is None:
        modest = max(min(order or 2 + held, _affordable(part, config.max_order)), held)
        quick = Refinement(iterations=5, integrators=held)
        for d in tracked(range(MOST_DELAY + 1), "delay"):
            error = fit([r.with_delay(d) for r in part], modest, quick).error
            delay_errors[d] = float(np.sqrt(error))
        limit = np.sqrt(1.02) * max(min(delay_errors.values()), rounding)
        delay = next(d for d, error in delay_errors.items() if error <= limit)
    if order is None:
        quick = replace(refinement, iterations=min(refinement.iterations, 15))
        late = [r.with_delay(delay) for r in part]
        highest = max(_affordable(late, config.max_order), held)
        least = min(max(1, held), highest)
        tried = range(least, highest + 1)
        errors = unseen_errors(late, context, tried, quick)
        order_errors = dict(zip(tried, errors, strict=True))
        limit = max(min(errors), rounding) * (1 + config.tolerance)
        order = next((n for n, error in order_errors.items() if error <= limit), least)
    return Selection(order, delay, order_errors, delay_errors)


def fit_records(
    records: ScaledData, context: Context, config: Config, refinement: Refinement
) -> tuple[LinearFit, int, list[ScaledTrajectory]]:
    """Choose delay and order, then refine the fit.

    Returns:
        The fit, the delay, and the records of the fit, their inputs delayed: all of them, or
            segments where they are too long for memory.
    """
    refinement = replace(refinement, integrators=config.integrators)
    chosen = select(records, context, config, refinement)
    delay, order = chosen.delay, chosen.order
    # Number of samples whose Jacobian fits in memory, with the transforms it is made by.
    late = stretches(
        [r.with_delay(delay) for r in records],
        max(1000, _JACOBIAN_NUMBERS // numbers_of(order, context.nu, context.ny)),
        2 * past_length(context) + 100 * order,
    )
    found = reused(
        "linear", (late, order, refinement), lambda log: fit(late, order, refinement, log),
        context.log,
    )  # fmt: skip
    found = refined_under_noise(late, found, refinement, context.sampling_time, context.log)
    return found, delay, late


def _fit_with_responses(
    records: ScaledData, context: Context, config: Config, refinement: Refinement, scaling: Scaling
) -> tuple[LinearFit, int, list[ScaledTrajectory]]:
    """Fit as `fit_records`, together with the frequency responses; an open order or delay is the
    records' own or the responses', by the Bayesian information criterion."""
    responses = sampled_responses(context, scaling)
    found, delay, used = fit_records(records, context, config, refinement)
    orders, delays = {found.system.order}, {delay}
    if config.order is None:
        highest = max(_affordable(records, config.max_order), found.system.order)
        orders.add(min(max(one.order for one in responses), highest))
    if config.delay is None:
        delays |= {min(one.delay, MOST_DELAY) for one in responses}
    first, held = (found.system.order, delay), replace(refinement, integrators=config.integrators)
    tried: list[tuple[float, tuple[LinearFit, int, list[ScaledTrajectory]]]] = []
    for n, d in itertools.product(sorted(orders), sorted(delays)):
        start, late = found, used
        if (n, d) != first:
            known = replace(config, order=n, delay=d)
            start, _, late = fit_records(records, context, known, refinement)
        joint, value = fit_jointly(late, [one.delayed(d) for one in responses], start, held)
        parameters = (n + 1) * (context.nu + context.ny)
        value += parameters * np.log(sum(len(r) for r in late) * context.ny)
        tried.append((float(value), (joint, d, late)))
    return min(tried, key=lambda pair: pair[0])[1]


def fit_of_least_order(
    records: ScaledData, context: Context, choice: Config, least: int
) -> tuple[LinearFit, int, list[ScaledTrajectory]]:
    """Fit as `fit_records`; where the order is open, with at least so many states."""
    found, delay, used = fit_records(records, context, choice, Refinement())
    if choice.order is None and found.system.order < least:
        choice = replace(choice, order=least, delay=delay)
        return fit_records(records, context, choice, Refinement())
    return found, delay, used


def _selection(records: ScaledData, context: Context, config: Config) -> list[ScaledTrajectory]:
    """Records for the choice of order and delay: each segment leaves samples to simulate after
    its past window, enough of them to distinguish the states."""
    shortest = 3 * past_length(context) + 4 * config.max_order
    return shortened(records, _SELECTION_SAMPLES, shortest)


def _affordable(records: ScaledData, max_order: int) -> int:
    samples = min(len(r) for r in records) // 8
    return max(1, min(max_order, samples))
