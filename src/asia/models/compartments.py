"""Compartments in series: storages that fill and run off, as a grey-box that needs no equations.

Every output is the content of the last of a few storages in a row. The first takes up the inputs,
each runs off into the next at a rate that rises with its content, and none can be negative:
x1' = b u + e - q1(x1), xi' = gi q(i-1)(x(i-1)) - qi(xi), y = zero + span xn. The run-off is
proportional to the content, to its square root, or to a learned power of it. What
`asia.models.greybox` can add to equations can be added to these: limits, overflow, a bent sensor.
Source: Jacquez, Compartmental Analysis in Biology and Medicine, 1996.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Intersample, Trajectory
from asia.models import greybox
from asia.models._config import check_at_least, demand
from asia.models._equations.config import Sensor
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.training_records import check, measured_weight, regress_outputs
from asia.models._steps import TrainableModel
from asia.problem.physics import Bounds, ParameterRange, Physics

Outflow = Literal["linear", "root", "power"]

# Range of the run-off a sample, and greatest ratio of the fastest filling to it.
_RATES, _LARGEST_GAIN = (1e-3, 0.5), 10.0
_EXPONENTS = (0.3, 1.5)
# Content below which a power is smooth.
_EMPTY = 1e-3
# Greatest distance of an output's zero below its observed values, in spans, and lengths of the
# segments for the sign of an input's effect, in samples.
_BELOW, _LOOK_AHEAD = 0.5, (2, 5, 15, 40)


@dataclass(frozen=True)
class Config:
    """Storages, and the additions to them: settings of `greybox.Config`."""

    count: int = 2
    """Storages in a row, for each output."""
    outflow: Outflow = "root"
    """Rise of the run-off with the content: "linear", with its square "root", or with a learned
    "power"."""
    full: bool = False
    """Give every storage a learned limit."""
    spill: bool = False
    """Let a learned fraction of what a full storage cannot hold go into the next."""
    sensor: Sensor | None = None
    """A rising curve between content and output."""
    intersample: Intersample | None = None
    """As in `greybox.Config`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "count")
        demand(self, "outflow", self.outflow in get_args(Outflow), "linear, root or power")
        demand(self, "spill", self.full or not self.spill, "False unless full")


@dataclass(frozen=True)
class Compartments(TrainableModel[Config, greybox.GreyBox]):
    """Storages in series."""

    label = "compartments"

    def parameters(self) -> dict[str, float]:
        """Run-offs, gains and zeros by name."""
        return self._trained().parameters()


def build(config: Config, context: Context) -> Compartments:
    """Build an untrained model."""
    del context
    return Compartments(config)


def train(
    model: Compartments,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt,
) -> Compartments:
    """Write the balances in the units of the records and fit them as `greybox.train` does.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    check(trajectories, context)
    c = model.config
    # Equations need names that are plain and not taken.
    context = replace(
        context,
        inputs=tuple(replace(s, name=f"u{j}") for j, s in enumerate(context.inputs)),
        outputs=tuple(replace(s, name=f"y{k}") for k, s in enumerate(context.outputs)),
    )
    physics = balances(c, trajectories, context)
    context = replace(context, physics=physics)
    added = greybox.Config(
        saturation=physics.states if c.full else (),
        spill=c.spill,
        intersample=c.intersample,
        sensor=c.sensor,
    )
    fitted = greybox.train(greybox.build(added, context), trajectories, context, method)
    return replace(model, fitted=fitted)


def balances(config: Config, trajectories: Sequence[Trajectory], context: Context) -> Physics:
    """Make the equations, with ranges from the records and the names of the signals."""
    u = np.concatenate([t.u for t in trajectories])
    constants: dict[str, float] = {}
    for j in range(context.nu):
        constants[f"low{j}"] = float(u[:, j].min())
        constants[f"width{j}"] = float(np.ptp(u[:, j])) or 1.0
    slow, fast = (rate / context.sampling_time for rate in _RATES)
    signs = _effects(trajectories)
    dynamics: dict[str, str] = {}
    observation: dict[str, str] = {}
    parameters: dict[str, ParameterRange] = {}
    for k, output in enumerate(context.outputs):
        inflows: list[str] = []
        for j, signal in enumerate(context.inputs):
            scaled = f"({signal.name} - low{j})/width{j}"
            parameters[f"inflow{k}_{j}"] = ParameterRange(slow, _LARGEST_GAIN * fast)
            inflows.append(f"inflow{k}_{j}*{scaled if signs[j, k] > 0 else f'(1 - {scaled})'}")
        parameters[f"rest{k}"] = ParameterRange(0.0, 0.1 * fast)
        inflow = " + ".join([*inflows, f"rest{k}"])
        for i in range(config.count):
            state, rate, power = f"x{k}_{i}", f"rate_{k}_{i}", f"power_{k}_{i}"
            parameters[rate] = ParameterRange(slow, fast)
            if config.outflow == "linear":
                run_off = f"{rate}*{state}"
            elif config.outflow == "root":
                run_off = f"{rate}*sqrt({state})"
            else:
                parameters[power] = ParameterRange(*_EXPONENTS)
                run_off = f"{rate}*exp({power}*log({state} + {_EMPTY!r}))"
            dynamics[state] = f"{inflow} - {run_off}"
            if i + 1 < config.count:
                parameters[f"gain{k}_{i}"] = ParameterRange(0.3, 3.0)
            inflow = f"gain{k}_{i}*{run_off}"
        y = np.concatenate([t.y[:, k] for t in trajectories])
        low, span = float(y.min()), float(np.ptp(y)) or 1.0
        parameters[f"zero{k}"] = ParameterRange(low - _BELOW * span, low)
        observation[output.name] = f"zero{k} + {span!r}*x{k}_{config.count - 1}"
    return Physics(
        states=tuple(dynamics),
        dynamics=dynamics,
        parameters=parameters,
        constants=constants,
        observation=observation,
        bounds={name: Bounds(min=0.0) for name in dynamics},
    )


def _effects(trajectories: Sequence[Trajectory]) -> Array:
    """Signs (nu, ny) of the effects of the inputs.

    The change of an output over a segment of samples is regressed on its initial value and on the
    mean inputs in between.
    """
    total = np.zeros((trajectories[0].u.shape[1], trajectories[0].y.shape[1]))
    for ahead in _LOOK_AHEAD:
        parts = list[tuple[Array, Array, Array]]()
        for t in trajectories:
            if len(t.y) <= ahead:
                continue
            sums = np.cumsum(np.concatenate([np.zeros((1, t.u.shape[1])), t.u]), axis=0)
            means = (sums[ahead:-1] - sums[: -1 - ahead]) / ahead
            weight = measured_weight(t)[ahead:] * measured_weight(t)[:-ahead]
            row = np.concatenate([means, t.y[:-ahead], np.ones((len(means), 1))], axis=1)
            parts.append((row, t.y[ahead:] - t.y[:-ahead], weight))
        if parts:
            x, y, weight = map(np.concatenate, zip(*parts, strict=True))
            theta = regress_outputs(x, y, weight, lambda x, y: np.linalg.lstsq(x, y)[0])
            total += np.sign(theta[: len(total)])
    return np.where(total < 0, -1.0, 1.0)
