"""Reference models that every search scores."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from math import inf
from statistics import median_high, median_low

import numpy as np

from asia.data.relations import LARGEST_GAIN, LEAST_CORRELATION, motion
from asia.data.segment import Segment
from asia.data.trajectory import Array
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.scoring.outcome import Outcome, Score, score_outputs
from asia.problem.folds import Fold
from asia.problem.problem import Problem

Rates = tuple[int | None, ...]

CONTROLLERS = {
    "inputs held": '''"""Inputs held at their start."""

import numpy as np


class Controller:
    def __init__(self, u):
        self.u = u

    def step(self, r, y):
        return self.u


def design(models, context):
    return Controller(np.array([a.start for a in context.control.actuators]))
''',
    "relay-tuned PID": '''"""PID loops tuned with a relay on the identified model."""

from asia.models import controllers


def design(models, context):
    return controllers.relay(models, context)
''',
    "PID of asia control": '''"""PID loops by the optimisation of `asia control`, one by one."""

import numpy as np

from asia.control.design import Specification, Transfer, sampled
from asia.control.design import design as optimised
from asia.errors import UserError
from asia.lowering.linear import continuous, reduced
from asia.models import controllers


def transfer(model):
    order = model.order
    while True:
        try:
            same, dead = continuous(reduced(model, order).model)
            break
        except UserError:
            order -= 1
            if not order:
                raise
    numerators, den = same.numerator()
    return Transfer(np.trim_zeros(numerators[0][0], "f"), den, (dead + 0.5) * model.sampling_time)


def tuned(models, pair):
    plants = [transfer(model) for model in models]
    wanted = Specification(2.0, 45.0, None, plants[0].own_settling, 10.0, 1e-3)
    made = optimised(plants, wanted, effort=30)
    return sampled(
        made.controller, models[0].sampling_time, u0=pair.u0, y0=pair.y0,
        limits=(pair.low, pair.high), rate=pair.rate,
    )


def design(models, context):
    return controllers.paired(models, context, tuned)
''',
}
"""Reference controllers by name."""
CONTROLLER = '''"""PID loops, optimised in simulation with the identified models."""

from asia.models import controllers


def design(models, context):
    return controllers.pid(models, context)
'''
"""First candidate of a control problem that brings none."""


def find_rates(fold: Fold, horizon: int) -> Rates:
    """Find for each output the output that is its rate of change, from the training records.

    It is the one whose integral over `horizon` samples correlates best with the output's own
    increment, with a correlation above 0.6 and a gain between 2/3 and 3/2; None where there is
    none.
    """
    found = motion(fold.train, horizon)
    gain, correlation = found.gain, found.correlation
    fits = (correlation > LEAST_CORRELATION) & (gain > 1 / LARGEST_GAIN) & (gain < LARGEST_GAIN)
    np.fill_diagonal(fits, False)
    best = np.where(fits, correlation, 0.0).argmax(axis=1).tolist()
    return tuple(j if fits[i, j] else None for i, j in enumerate(best))


def constant_velocity(block: Segment, rates: Rates, sampling_time: float) -> Array:
    """(H, ny): outputs with a rate move on at its last measured value (Euler steps of
    `sampling_time`, s); the others at their mean rate over the past window, of which one sample
    holds the output."""
    past = block.past_y
    slope = (past[-1] - past[0]) / max(len(past) - 1, 1)
    for output, rate in enumerate(rates):
        if rate is not None:
            slope[output] = sampling_time * past[-1, rate]
    return past[-1] + np.arange(1, len(block.y) + 1)[:, None] * slope


# Simple references that every search scores, to compare V with.

TRUTH = "simulated truth"
LINEAR_REFERENCE = "linear model"
MEAN_REFERENCE = "training mean"
LINEAR = '''"""Best linear model: state-space, order and delay chosen inside the training data."""

from asia.models import linear
from asia.models.methods import LevenbergMarquardt


def build_model(context):
    config = linear.Config(order=None, delay=None, periodic=True)
    return linear.build(config, context)


def train(model, trajectories, context):
    method = LevenbergMarquardt(iterations=30)
    return linear.train(model, trajectories, context, method)


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
'''


@dataclass(frozen=True)
class Reference:
    """A simple reference, scored."""

    name: str
    outcome: Outcome
    failed_checks: tuple[str, ...] = ()
    """Diagnostics that raised an exception, a line each."""
    source: str = ""
    """Candidate of a linear model, where it is another one than the usual baseline."""


def score_references(
    evaluator: Evaluator, metric: str, truth: Sequence[Array] | None, known: Set[str]
) -> Iterator[Reference]:
    """Training mean, last output held, for windows constant velocity where the past window or
    another output gives one, best linear model where samples are regular; for simulated problems
    also the noise-free truth, whose V is the noise floor.

    Names in `known` are passed over.

    Args:
        truth: one (T, ny) array a training record
    """
    if evaluator.data.context.control is not None:
        yield from control_references(evaluator, known)
        return
    folds, horizon = evaluator.data.folds, evaluator.data.horizon
    past = len(folds[0].held_out[0].past_y)
    simulations: dict[str, Callable[[Fold, Segment], Array]] = {
        MEAN_REFERENCE: training_mean,
        # The training mean where the protocol gives no past output.
        "last output held": (
            (lambda _, block: np.tile(block.past_y[-1], (len(block.y), 1)))
            if past
            else training_mean
        ),
    }
    if horizon is not None and past:
        rates = [find_rates(fold, horizon) for fold in folds]
        # A single past output tells no velocity where no output is another's rate.
        if past > 1 or any(rate is not None for found in rates for rate in found):
            simulations["constant velocity"] = lambda fold, block: constant_velocity(
                block, rates[fold.index], fold.train[0].sampling_time
            )

    def score(simulate: Callable[[Fold, Segment], Array]) -> Outcome:
        outputs = [[simulate(fold, block) for block in fold.held_out] for fold in folds]
        return score_outputs(folds, outputs, metric)

    for name, simulate in simulations.items():
        if name not in known:
            yield Reference(name, score(simulate))
    irregular = any(s.role == "time_step" for s in evaluator.data.context.inputs)
    if LINEAR_REFERENCE not in known and not irregular:
        yield best_linear(evaluator)
    if truth is not None and TRUTH not in known:
        yield Reference(
            TRUTH, score(lambda _, block: truth[block.record][block.start : block.stop])
        )


BASELINE = LINEAR
"""First experiment of a search for a model."""


def first_source(problem: Problem) -> str:
    """Source of the first experiment of a search."""
    if problem.baseline is None and problem.loop is not None and problem.loop.methods:
        return in_loop(problem.loop.methods[0])
    return problem.baseline or (BASELINE if problem.control is None else CONTROLLER)


def in_loop(method: str) -> str:
    """Source of the best linear model by a method for records from a closed loop."""
    return LINEAR.replace("periodic=True", f'loop="{method}"')


def control_references(evaluator: Evaluator, known: Set[str]) -> Iterator[Reference]:
    """Inputs held at their start, PID loops tuned with a relay, and those of `asia control`."""
    for name, source in CONTROLLERS.items():
        if name not in known:
            found = evaluator.evaluate(source)
            yield Reference(name, found.outcome, found.failed_checks, source)


def best_linear(evaluator: Evaluator) -> Reference:
    """Score linear models and return the one of least V.

    Tried are the least simulation error with order and delay chosen in each fold, the same with the
    median choice in all folds where these differ, the least prediction error, which is less easily
    misled by drift and slow noise, and regularised impulse responses and difference equations.
    With a declared loop it is the first method for it that gives a model: others may have a lower V
    with biased gains.
    """
    loop = evaluator.data.context.loop
    for method in loop.methods if loop is not None else ():
        source = in_loop(method)
        found = evaluator.evaluate(source)
        if isinstance(found.outcome, Score) or method == "two_stage":
            return Reference(LINEAR_REFERENCE, found.outcome, found.failed_checks, source)

    def scored(**changes: str) -> tuple[Evaluation, str]:
        source = LINEAR
        for name, value in changes.items():
            source = re.sub(rf"\b{name}=\w+", f"{name}={value}", source, count=1)
        return evaluator.evaluate(source), source

    options = [scored()]
    known = [dict(record.parameters) for record in options[0][0].folds]
    names = "order [states]", "delay [samples]"
    each = [(round(one[names[0]]), round(one[names[1]])) for one in known if names[1] in one]
    if len(set(each)) > 1:
        orders, delay = [n for n, _ in each], str(median_low(d for _, d in each))
        both = {median_low(orders), median_high(orders)}
        options += [scored(order=str(n), delay=delay) for n in sorted(both)]
    if each and evaluator.data.horizon is None:
        others = ('loop="direct"', 'regularised="response"', 'regularised="equation"')
        options += [scored(periodic=f"False, {other}", delay="0") for other in others]

    def value(option: tuple[Evaluation, str]) -> float:
        outcome = option[0].outcome
        return outcome.value if isinstance(outcome, Score) else inf

    best, source = min(options, key=value)
    other = "" if source == LINEAR else source
    return Reference(LINEAR_REFERENCE, best.outcome, best.failed_checks, other)


def training_mean(fold: Fold, block: Segment) -> Array:
    """Mean (H, ny) of the measured outputs of a fold's training records, for each sample of a
    block."""
    y = np.concatenate([t.measured_y for t in fold.train])
    mean = np.nanmean(y, axis=0) if np.isnan(y).any() else y.mean(axis=0)
    return np.tile(mean, (len(block.y), 1))
