"""Wiener-Hammerstein model: a linear system, a static function and a linear system in series.

It has one input and one output. The poles and zeros of linear models of several orders are
distributed over the two systems in every way, and the ways compete in many short fits; the function
is a sum of tanh units added to the identity. A function at one end alone (Hammerstein, Wiener, or
both) is `asia.models.neural_ss` with nonlinearity "input", "output" or "both"; with more inputs or
outputs use `asia.models.nl_lfr`.
Sources: Giri and Bai (eds.), Block-oriented Nonlinear System Identification, 2010; Schoukens and
Tiels, Automatica 85, 2017.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.models import linear
from asia.models._config import check_at_least
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import NoiseChoice
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import window_segments
from asia.models._numerics.training_records import check, scaled
from asia.models._state_space.model import LINEAR_RIDGE, FittedStateSpace
from asia.models._steps import TrainableModel

__all__ = ["BlockOriented", "Config", "build", "train"]

# Greatest number of windows for a problem with a horizon; each has its own initial state.
_WINDOWS = 40
# Ridge of the initial states of the two filters.
_INITIAL_RIDGE = 1e-8


@dataclass(frozen=True)
class Config:
    """Size of the linear systems and of the static function."""

    order: int | None = None
    """States of both systems together; None tries 2 to 8."""
    hidden: int = 8
    """Units of the static function, on a fixed grid."""
    ridge: float = 1e-5
    """Weight, against the mean squared error in z-scores, of the squared distance of the function's
    weights from their start."""
    linear_ridge: float = LINEAR_RIDGE
    """Weight of the squared distance of the linear systems from their start."""
    delay: int | None = 0
    """Samples by which the input is delayed; None compares none with that of a linear model."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "order", "hidden")
        check_at_least(0, self, "ridge", "linear_ridge", "delay")


@dataclass(frozen=True)
class BlockOriented(TrainableModel[Config, FittedStateSpace]):
    """Wiener-Hammerstein model."""

    label = "Wiener-Hammerstein model"


build = BlockOriented.build


def train(
    model: BlockOriented,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt,
) -> BlockOriented:
    """Search order, delay and the shares of poles and zeros, then fit all parameters to the
    simulation error.

    `method.starts` of the ways reach the last fit. Where the problem has a horizon, windows of that
    length from all over the records are fitted.

    Raises:
        UserError: for more than one input or output, and for records too short or mis-shaped.
    """
    check(trajectories, context)
    if (context.nu, context.ny) != (1, 1):
        raise UserError(
            f"block_oriented: {context.nu} inputs and {context.ny} outputs, expected one of each; "
            "use nl_lfr"
        )
    from asia.models._state_space.fit import StateFit, fit_states, of_records, state_encoder
    from asia.models._state_space.wiener_hammerstein import FilterRidge, searched

    c, segments = model.config, window_segments(trajectories, context, _WINDOWS)
    scaling = Scaling.of(segments)
    records = scaled(segments, scaling)
    choice = linear.Config(order=c.order, delay=c.delay)
    ridge = FilterRidge(c.linear_ridge, c.ridge, _INITIAL_RIDGE)
    found = searched(records, context, choice, c.hidden, ridge, method, context.log)
    late = [r.with_delay(found.delay) for r in records]
    structure, params = found.filters.state_space()
    best = StateFit(found.filters.x0, params, found.error, found.history)
    if NoiseChoice.of(method) is not None:
        weights = dict.fromkeys(params, c.linear_ridge) | {"f": c.ridge, "x0": _INITIAL_RIDGE}
        samples, time = of_records(late, best.x0), context.sampling_time
        best = fit_states(structure, [params], samples, weights, method, context.log, time)[0]
    encoder = state_encoder(structure, best, late, context)
    fitted = FittedStateSpace(structure, best.params, encoder, found.delay, scaling)
    return replace(model, fitted=fitted)
