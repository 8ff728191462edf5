"""ARX and output-error models: a linear difference equation between inputs and outputs.

y[k] = sum_i A_i y[k-i] + sum_j B_j u[k-delay-j] + c. "arx" fits the equation by least squares;
"oe" goes on from there to the least simulation error, where noise on the measured outputs no
longer biases the coefficients. Lags the past window is too short for come from a regression on it.
With a scheduling signal p the coefficients can be polynomials in p[k-delay] (a linear
parameter-varying model).
Sources: Ljung, System Identification, 2nd ed., sections 4.2 and 10.2; Bamieh and Giarre, Int. J.
Robust Nonlinear Control 12(9), 2002 (LPV).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models._config import check_at_least, check_choice
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import refuse_noise
from asia.models._numerics.lags import fit_history
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import segments, simulation_error
from asia.models._numerics.training_records import ScaledData, check, past_length, scaled
from asia.models._one_step import (
    FreeRunModel,
    LagChoice,
    PolynomialRun,
    build,
    choose_lags,
    choose_ridge,
    linear_run,
    refine,
    refinement_samples,
    selection,
    usable,
)
from asia.models.methods import LeastSquares

__all__ = ["Config", "build", "train"]


@dataclass(frozen=True)
class Config:
    """Lags of the equation, and the error that its coefficients minimise."""

    na: int | None = None
    """Lagged outputs; None chooses among 1..max_order by the simulation error on segments left out
    of the training data."""
    nb: int | None = None
    """Lagged inputs, chosen alike."""
    delay: int | None = 0
    """Samples before the newest input that acts: 0 lets u[k] act on y[k], None chooses among
    0..10."""
    structure: Literal["arx", "oe"] = "oe"
    """"arx": the error of the prediction one sample ahead; "oe": the simulation error."""
    max_order: int = 6
    """Greatest number of lags tried where `na` or `nb` is None."""
    scheduling: int = 0
    """Degree of the coefficients in the inputs with `role = "scheduling"`: 1 is affine; 0 takes
    these as inputs like any other."""

    def __post_init__(self) -> None:
        check_choice(self, "structure", ("arx", "oe"))
        check_at_least(1, self, "na", "nb", "max_order")
        check_at_least(0, self, "delay", "scheduling")


def train(
    model: FreeRunModel[Config],
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LeastSquares | LevenbergMarquardt,
) -> FreeRunModel[Config]:
    """Fit by least squares for "arx", then by Levenberg-Marquardt on the simulation error for "oe".

    For "arx" Levenberg-Marquardt would take the same single step.

    Raises:
        UserError: for records too short or mis-shaped and for "oe" without Levenberg-Marquardt.
    """
    c = model.config
    if c.structure == "oe" and isinstance(method, LeastSquares):
        raise UserError(
            "arx.train: structure oe minimises the simulation error, give LevenbergMarquardt"
        )
    if isinstance(method, LevenbergMarquardt):
        refuse_noise(method, "arx")
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    choice = LagChoice(c.na, c.nb, c.delay, c.max_order, scheduling=c.scheduling)
    lags = choose_lags(records, context, choice)
    usable(records, lags)

    def fit(records: ScaledData, ridge: float) -> PolynomialRun:
        # Outputs of an unstable model are limited to ten widths of the training range.
        return linear_run(records, lags, context, ridge, 10.0, c.scheduling)

    ridge = method.ridge if isinstance(method, LeastSquares) else None
    if ridge is None:
        part = selection(records, context, lags.memory)
        ridge = choose_ridge(part, context, fit, lags.memory)
    run = fit(records, ridge)
    if c.structure == "oe" and isinstance(method, LevenbergMarquardt):
        run = _output_error(records, context, (fit(records, 1e-7), run), method)
    data = segments(records, context)
    if data is not None:
        context.log(0, float(np.sqrt(simulation_error(run, data))))
    return replace(model, run=run, scaling=scaling)


def _output_error(
    records: ScaledData,
    context: Context,
    starts: Sequence[PolynomialRun],
    method: LevenbergMarquardt,
) -> PolynomialRun:
    """Refine the best start; return the last one for records too short."""
    data = segments(records, context, refinement_samples(starts[0]))
    if data is None:
        return starts[-1]
    start = min(starts, key=lambda run: simulation_error(run, data))
    refined, history = refine(start, data, method, 0.0)
    for i, loss in enumerate(history):
        context.log(i, loss)
    if context.horizon is not None:
        return refined
    # Regress the model's own lagged outputs, which are free of the noise of the measured ones, on
    # the past window.
    past = past_length(context)
    outputs: list[Array] = []
    for r in records:
        start_u = r.undelayed_u[None, past - context.n_past_u : past]
        start_y = r.y[None, past - context.n_past_y : past]
        simulated = refined(start_u, start_y, r.u[None, past:])[0]
        outputs.append(np.concatenate([r.y[:past], simulated]))
    own = replace(refined, history=fit_history(records, refined.history.lags, context, outputs))
    return min((refined, own), key=lambda run: simulation_error(run, data))
