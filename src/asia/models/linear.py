"""Linear state-space model: subspace start, then refinement of the simulation error.

x[k+1] = A x[k] + B u[k - delay],  y[k] = C x[k] + D u[k - delay] + offset, with the initial state
estimated from the past window. Source: Ljung, System Identification, 2nd ed., chapters 4 and 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asia.candidate import Context
from asia.errors import UserError
from asia.models._encoder import Encoder
from asia.models._linear_fit import LinearFit, Refinement, choose_order, encoder_of, fit
from asia.models._linear_system import LinearSystem
from asia.models._records import Record, check, past_length, scaled, shortened, window
from asia.models._scaling import Scaling
from asia.problem import Array, Trajectory

if TYPE_CHECKING:
    from asia.models._lm import LevenbergMarquardt

# Choosing order and delay takes dozens of fits; this many samples tell candidates apart.
_SELECTION_SAMPLES = 3000


@dataclass(frozen=True)
class Config:
    """order: number of states, None chooses among 1..max_order by the simulation error on blocks
    inside the training data, preferring the smallest within `tolerance` of the best. delay:
    samples by which every input is delayed beyond what the states can express, None estimates it
    among 0..max_delay."""

    order: int | None = None
    max_order: int = 6
    tolerance: float = 0.03
    delay: int | None = 0
    max_delay: int = 10

    def __post_init__(self) -> None:
        if self.order is not None and self.order < 1:
            raise UserError(f"linear.Config: order is {self.order}, expected at least 1 or None")
        if self.max_order < 1 or self.max_delay < 0 or (self.delay or 0) < 0:
            raise UserError("linear.Config: max_order must be >= 1, delay and max_delay >= 0")


@dataclass(frozen=True)
class Fitted:
    """What training found: system in z-scores, delay in samples, encoder of the past window."""

    system: LinearSystem
    delay: int
    scaling: Scaling
    encoder: Encoder


@dataclass(frozen=True)
class LinearStateSpace:
    """Linear model; `fitted` is None before training."""

    config: Config
    fitted: Fitted | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu), physical units ->
        (B, H, ny). The input before a past window that is shorter than the delay is taken to be
        the window's first. Raises UserError before training."""
        if self.fitted is None:
            raise UserError("linear model: not trained yet; call linear.train before simulate")
        f = self.fitted
        past, future = f.scaling.inputs(past_u), f.scaling.inputs(u)
        x0 = f.encoder(window(past, f.scaling.outputs(past_y)))
        _, y = f.system.simulate(x0, delayed(past, future, f.delay))
        return f.scaling.physical(y)


def build(config: Config, context: Context) -> LinearStateSpace:
    """An untrained model."""
    del context
    return LinearStateSpace(config)


def train(
    model: LinearStateSpace,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt | None = None,
) -> LinearStateSpace:
    """Fits to the simulation error of all records at once; `method` sets iterations, damping and
    tolerance. Raises UserError for records too short or with the wrong channels."""
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    found, delay = fit_records(records, context, model.config, refinement_of(method))
    context.log(0, float(np.sqrt(found.error)))
    encoder = encoder_of([shifted(r, delay) for r in records], found, context)
    return replace(model, fitted=Fitted(found.system, delay, scaling, encoder))


def refinement_of(method: LevenbergMarquardt | None) -> Refinement:
    """The NumPy refinement with a method's settings."""
    if method is None:
        return Refinement()
    return Refinement(method.iterations, method.damping, max(method.tolerance, 1e-9))


def fit_records(
    records: Sequence[Record], context: Context, config: Config, refinement: Refinement
) -> tuple[LinearFit, int]:
    """Delay, order, then the refined fit to all samples; returns the fit and the delay."""
    part = _selection(records, context, config)
    delay = _estimate_delay(part, config) if config.delay is None else config.delay
    late = [shifted(r, delay) for r in records]
    order = config.order
    if order is None:
        quick = replace(refinement, iterations=min(refinement.iterations, 15))
        late_part = [shifted(r, delay) for r in part]
        highest = _affordable(late_part, config.max_order)
        order = choose_order(late_part, context, highest, config.tolerance, quick)
    return fit(late, order, refinement), delay


def shifted(record: Record, delay: int) -> Record:
    """The record with its inputs delayed; the first input is held backwards."""
    if delay == 0:
        return record
    held = np.repeat(record.u[:1], delay, axis=0)
    return replace(record, u=np.concatenate([held, record.u])[: len(record)])


def delayed(past: Array, future: Array, delay: int) -> Array:
    """Inputs (B, H, nu) that act during the simulation, from the measured past (B, n_past_u, nu)
    and future (B, H, nu); before the first known one it is held backwards."""
    known = np.concatenate([past, future], axis=1)
    rows = np.arange(past.shape[1], known.shape[1]) - delay
    return known[:, np.maximum(rows, 0)]


def _selection(records: Sequence[Record], context: Context, config: Config) -> list[Record]:
    """What order and delay are chosen on: every piece leaves samples to simulate after its past
    window, enough of them to tell the states apart."""
    shortest = 3 * past_length(context) + 4 * config.max_order
    return shortened(records, _SELECTION_SAMPLES, shortest)


def _affordable(records: Sequence[Record], max_order: int) -> int:
    samples = min(len(r) for r in records) // 8
    return max(1, min(max_order, samples))


def _estimate_delay(records: Sequence[Record], config: Config) -> int:
    """Delay with the least simulation error of a model of modest order, preferring the smallest
    within 1 %."""
    order = min(config.order or 2, _affordable(records, config.max_order))
    quick = Refinement(iterations=5)
    errors = [
        fit([shifted(r, d) for r in records], order, quick).error
        for d in range(config.max_delay + 1)
    ]
    return next(d for d, error in enumerate(errors) if error <= 1.02 * min(errors))
