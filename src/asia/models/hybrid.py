"""Hybrid: a grey-box, and a small network for the residual of its equations.

    model = hybrid.build(hybrid.Config(units=4), context)
    model = hybrid.train(model, trajectories, context, LevenbergMarquardt(iterations=60, starts=8))

The grey-box is fitted first. The network is a function of states and inputs, added to the
dynamics; its output layer starts at zero and every step is refused that would raise the cost, so
that on its training records a hybrid never has a higher regularised cost than its grey-box.
Source: Psichogios and Ungar, AIChE Journal 38(10), 1992.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from asia.candidate import Context
from asia.data.trajectory import Intersample, Trajectory
from asia.models import greybox
from asia.models._least_squares import LevenbergMarquardt
from asia.models.greybox import GreyBox

__all__ = ["Config", "build", "train"]


@dataclass(frozen=True)
class Config:
    """Grey-box, and the network added to its dynamics."""

    base: greybox.Config = field(default_factory=greybox.Config)
    """Grey-box under the network."""
    units: int = 4
    """Hidden tanh units of the network."""
    ridge: float = 1e-2
    """Weight of the network's squared coefficients beside the mean squared normalised error."""
    intersample: Intersample | None = None
    """As in `greybox.Config`, in place of that of `base`."""

    def __post_init__(self) -> None:
        if self.units < 1 or self.ridge < 0:
            raise ValueError("hybrid.Config: units must be >= 1 and ridge >= 0")
        if self.base.residual:
            raise ValueError("hybrid.Config: give the network's size as units, not in base")


def build(config: Config, context: Context) -> GreyBox:
    """Build an untrained model.

    Raises:
        ValueError: if the problem has no physics.
        UserError: if the physics do not fit the signals.
    """
    if context.physics is None:
        raise ValueError(
            "hybrid: the problem has no [physics]; give states and dynamics, or use a black-box "
            "family"
        )
    with_network = replace(
        config.base,
        residual=config.units,
        residual_ridge=config.ridge,
        intersample=config.intersample or config.base.intersample,
    )
    return greybox.build(with_network, context)


def train(
    model: GreyBox, trajectories: Sequence[Trajectory], context: Context, method: LevenbergMarquardt
) -> GreyBox:
    """Fit the grey-box to the simulation error, then the whole with its network."""
    return greybox.train(model, trajectories, context, method)
