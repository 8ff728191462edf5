"""Linear systems in series with static functions: Hammerstein, Wiener and their combinations.

"hammerstein": function, system; "wiener": system, function; "hammerstein_wiener": function,
system, function; "wiener_hammerstein": system, function, system. All start as the best linear
model; the functions are small tanh networks or polynomials added to the identity.
Sources: Giri and Bai (eds.), Block-oriented Nonlinear System Identification, 2010; Schoukens and
Tiels, Automatica 85, 2017.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models import linear, neural_ss
from asia.models._config import check_choice
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import window_segments
from asia.models._numerics.training_records import check, scaled
from asia.models._state_space.model import FittedStateSpace
from asia.models._state_space.structure import Basis, Nonlinearity
from asia.models._state_space.wiener_hammerstein import WienerHammersteinStructure
from asia.models.neural_ss import NeuralStateSpace

__all__ = ["Config", "NeuralStateSpace", "build", "train"]

Blocks = Literal["hammerstein", "wiener", "hammerstein_wiener", "wiener_hammerstein"]

_PLACES: dict[str, Nonlinearity] = {
    "hammerstein": "input",
    "wiener": "output",
    "hammerstein_wiener": "both",
}
# Greatest number of windows for a problem with a horizon; each has its own initial state.
_WINDOWS = 40
# Ridge of the initial states of the two filters.
_INITIAL_RIDGE = 1e-8


@dataclass(frozen=True)
class Config:
    """Blocks, and size of the linear systems and static functions in them."""

    structure: Blocks = "wiener"
    """The blocks in series: "hammerstein", "wiener", "hammerstein_wiener", "wiener_hammerstein"."""
    order: int | None = None
    """States, of both systems together for "wiener_hammerstein"; None takes the order of the best
    linear model, but at least 2."""
    basis: Basis = "tanh"
    """A layer of tanh units, or of units sqrt(1 + z^2), or polynomials."""
    hidden: int = 8
    """Units of that layer."""
    degree: int = 3
    """Greatest degree of the polynomials."""
    ridge: float = 1e-5
    """Weight, against the mean squared error in z-scores, of the squared distance of the nonlinear
    weights from their start."""
    linear_ridge: float = 1e-7
    """Weight of the squared distance of the linear systems from their start."""
    encoder: int = 30
    """Units of the tanh layer of the map from the past window to the initial state."""
    delay: int | None = 0
    """Samples by which every input is delayed; None estimates it, see `linear.Config`."""
    searched: bool = False
    """Search order, delay and the shares of poles and zeros by many short fits of two filters and
    `hidden` units on a fixed grid, which takes little time for each sample. It applies to
    "wiener_hammerstein" with one input and output; with other structures, more inputs or outputs,
    or polynomials it changes nothing."""

    def __post_init__(self) -> None:
        check_choice(self, "structure", (*_PLACES, "wiener_hammerstein"))
        self.state_space()

    def state_space(self) -> neural_ss.Config:
        """Convert the settings to those of the neural state-space family."""
        return neural_ss.Config(
            self.order,
            _PLACES.get(self.structure, "state"),
            None,
            self.basis,
            self.hidden,
            self.degree,
            self.ridge,
            self.linear_ridge,
            self.encoder,
            delay=self.delay,
        )


@dataclass(frozen=True)
class BlockOriented(NeuralStateSpace):
    """Block-oriented model, simulated as a neural state-space model; `blocks` are its settings."""

    blocks: Config = Config()


def build(config: Config, context: Context) -> BlockOriented:
    """Build an untrained model."""
    del context
    return BlockOriented(config.state_space(), None, config)


def train(
    model: BlockOriented,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt,
) -> BlockOriented:
    """Fit the linear model, then all parameters to the simulation error.

    The fit with the least training cost from `method.starts` starts is returned. Where the problem
    has a horizon, windows of that length from all over the records are fitted.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    check(trajectories, context)
    segments = window_segments(trajectories, context, _WINDOWS)
    config = model.blocks
    if config.structure != "wiener_hammerstein":
        plain = neural_ss.build(model.config, context)
        return replace(model, fitted=neural_ss.train(plain, segments, context, method).fitted)
    from asia.models._state_space.fit import StateFit, fit_states, of_records, state_encoder
    from asia.models._state_space.wiener_hammerstein import (
        FilterRidge,
        searched,
        wiener_hammerstein_starts,
    )

    scaling = Scaling.of(segments)
    records = scaled(segments, scaling)
    choice = linear.Config(order=config.order, delay=config.delay)
    template = WienerHammersteinStructure(
        1, context.nu, context.ny, "state", config.basis, config.hidden, config.degree, None
    )

    def fit(
        structure: WienerHammersteinStructure,
        params: dict[str, Any],
        x0: Array,
        initial_ridge: float,
    ) -> StateFit:
        weights = dict.fromkeys(params, config.linear_ridge)
        weights |= {"f": config.ridge, "x0": initial_ridge}
        samples = of_records(late, x0)
        time = context.sampling_time
        return fit_states(structure, [params], samples, weights, method, lambda *_: None, time)[0]

    if config.searched and config.basis == "tanh" and context.nu == context.ny == 1:
        ridge = FilterRidge(config.linear_ridge, config.ridge, _INITIAL_RIDGE)
        found = searched(records, context, choice, config.hidden, ridge, method, context.log)
        delay, late = found.delay, [r.with_delay(found.delay) for r in records]
        structure, params = found.filters.state_space(template)
        best = StateFit(found.filters.x0, params, found.error, found.history)
        if method.noise_model != "white":
            best = fit(structure, params, best.x0, _INITIAL_RIDGE)
    else:
        found, delay, late = linear.fit_of_least_order(records, context, choice, 2)
        template = replace(template, order=found.system.order)
        rng = np.random.default_rng(context.seed)
        starts = wiener_hammerstein_starts(late, found.system, template, rng, method.starts)
        ridge = found.error / sum(len(r) for r in late)
        fits: list[tuple[StateFit, WienerHammersteinStructure]] = []
        for start in starts:
            x0 = np.zeros((len(late), start.structure.order))
            fits.append((fit(start.structure, start.params, x0, ridge), start.structure))
        best, structure = min(fits, key=lambda pair: pair[0].cost)
        for i, loss in enumerate(best.history):
            context.log(i, float(loss))
    member = best.params, state_encoder(structure, best, late, context, config.encoder)
    return replace(model, fitted=FittedStateSpace(structure, (member,), delay, scaling))
