"""Linear system with static functions in feedback: nonlinear linear fractional representation.

x[k+1] = A x + B u + E w,  y = C x + D u + F w + offset,  z = G x + H u,  w = f(z). The functions f
map `channels` signals to as many. With one channel Hammerstein, Wiener and Wiener-Hammerstein
systems are special cases, and systems with a spring or with friction in their loop. The fit begins
with linear models of several orders and with functions inferred from their residuals.
Sources: Schoukens and Toth, On the initialization of nonlinear LFR model identification with the
best linear approximation, IFAC 2020; Floren, Noel and Swevers, Inference and learning of nonlinear
LFR state-space models, arXiv 2503.14409.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models import linear
from asia.models._config import check_at_least
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import Refinement
from asia.models._numerics.segments import window_segments
from asia.models._numerics.training_records import check, scaled
from asia.models._state_space.model import FittedStateSpace, with_unit_states
from asia.models._steps import TrainableModel

if TYPE_CHECKING:
    from asia.models._state_space.feedback import LinearCore

# Greatest number of windows for a problem with a horizon; each has its own initial state.
_WINDOWS = 40
# Delays, in samples, that states can replace: a linear model of a nonlinear system may find one
# that does not exist.
_MODELLED = 3
# Orders of the first linear models, with one output and the order open.
_ORDERS = (1, 2, 3, 4)


@dataclass(frozen=True)
class Config:
    """Size of the state and of the static functions, and their ridges."""

    order: int | None = None
    """States; None tries several, up to four with one output, and around the order of the best
    linear model with more."""
    channels: int = 1
    """Signals that the functions read, and signals that they give."""
    hidden: int = 12
    """Units sqrt(1 + z^2) of the functions, which go on as straight lines where the records end."""
    ridge: float = 1e-6
    """Weight, against the mean squared error in z-scores, of the squared distance of the functions'
    weights from their start."""
    delay: int | None = None
    """Samples by which every input is delayed; None compares none with the delay of the best linear
    model."""
    integrators: int = 0
    """Free integrators: states whose pole is held at 1 and which the functions do not read."""
    pieces: bool = False
    """Compare the starts on short segments of the records, each with its own initial state."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "order", "hidden", "channels")
        check_at_least(0, self, "integrators", "ridge")


@dataclass(frozen=True)
class NonlinearLfr(TrainableModel[Config, FittedStateSpace]):
    """Nonlinear LFR model."""

    label = "nonlinear LFR model"


def _drifting(core: LinearCore) -> int:
    """Number of modes that neither die out within a third of the longest record nor turn twice in
    it."""
    samples = max(len(record) for record in core.records)
    poles = np.linalg.eigvals(core.found.system.a)
    slow = np.abs(poles) > np.exp(-3.0 / samples)
    return int((slow & (np.abs(np.angle(poles)) < 4 * np.pi / samples)).sum())


build = NonlinearLfr.build


def train(
    model: NonlinearLfr,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt,
) -> NonlinearLfr:
    """Fit linear models, `method.starts` starts for each, then all parameters to the simulation
    error.

    The two best starts go on after a quarter of the iterations. Where the problem has a horizon,
    windows of that length from all over the records are fitted.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    from asia.models._state_space.feedback import LinearCore, fit_feedback

    check(trajectories, context)
    c = model.config
    pieces = window_segments(trajectories, context, _WINDOWS)
    plain = linear.Config(c.order, delay=c.delay, integrators=c.integrators)
    scaling = linear.scaling_of(pieces, context, plain)
    records = scaled(pieces, scaling)
    first = LinearCore(*linear.fit_records(records, context, plain, Refinement()))
    # The best linear model may have more states, and a delay, in place of the static functions.
    best = first.delay, first.found.system.order
    if c.delay is not None:
        delays = [c.delay]
    elif best[0] > _MODELLED:
        delays = [0, best[0]]
    else:
        delays = [0]
    if c.order is not None:
        orders = [c.order]
    elif context.ny == 1:
        orders = [n for n in _ORDERS if n > c.integrators]
    else:
        orders = sorted({max(context.ny, best[1] + step) for step in (-1, 0, 1)})
    cores: list[LinearCore] = []
    for delay, order in product(delays, orders):
        if (delay, order) == best:
            cores.append(first)
        else:
            choice = replace(plain, order=order, delay=delay)
            cores.append(LinearCore(*linear.fit_records(records, context, choice, Refinement())))
    # A mode that the best linear model does not have follows the drift of these records.
    cores = [core for core in cores if _drifting(core) <= _drifting(first)] or cores
    cores = [
        core._replace(found=with_unit_states(core.found, core.records, c.integrators))
        for core in cores
    ]
    return replace(model, fitted=fit_feedback(cores, c, scaling, context, method))
