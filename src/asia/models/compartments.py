"""Compartments in series: storages that fill and run off, as a grey-box that needs no equations.

Every output is the content of the last of a few storages in a row. The first takes up the inputs,
each runs off into the next at a rate that rises with its content, and none can be negative:
x1' = b u + e - q1(x1), xi' = gi q(i-1)(x(i-1)) - qi(xi), y = zero + span xn. The run-off is
proportional to the content, to its square root, or to a learned power of it. What
`asia.models.greybox` can add to equations can be added to these: limits, overflow, a bent sensor.
Source: Jacquez, Compartmental Analysis in Biology and Medicine, 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models import greybox
from asia.models._arrays import AnyArray
from asia.models._config import check_at_least, demand
from asia.models._equations.config import Sensor
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.records import check
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
    linear: bool = False
    """Add a linear term in contents and inputs to the balances."""
    residual: int = 0
    """Hidden tanh units of a network added to the balances; 0 is none."""
    ridge: float = 1e-3
    """Weight of the squared linear term, against the mean squared error."""
    residual_ridge: float = 1e-2
    """Weight of the squared coefficients of the network."""
    substeps: int = 2
    """Runge-Kutta steps a sample."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "count", "substeps")
        check_at_least(0, self, "residual", "ridge", "residual_ridge")
        demand(self, "outflow", self.outflow in get_args(Outflow), "linear, root or power")
        demand(self, "spill", self.full or not self.spill, "False unless full")


@dataclass(frozen=True)
class Compartments:
    """Storages in series; `fitted` is None before training."""

    config: Config
    fitted: greybox.GreyBox | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny).

        Raises:
            UserError: before training.
        """
        return self._trained().simulate(past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        return self._trained().initial(past_u, past_y, u)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        return self._trained().step(state, u)

    def parameters(self) -> dict[str, float]:
        """Run-offs, gains and zeros by name."""
        return self._trained().parameters()

    def _trained(self) -> greybox.GreyBox:
        if self.fitted is None:
            raise UserError("compartments: not trained yet; call train first")
        return self.fitted


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
    c, context = model.config, _renamed(context)
    physics = balances(c, trajectories, context)
    context = replace(context, physics=physics)
    added = greybox.Config(
        saturation=physics.states if c.full else (),
        spill=c.spill,
        linear=c.linear,
        residual=c.residual,
        ridge=c.ridge,
        residual_ridge=c.residual_ridge,
        substeps=c.substeps,
        sensor=c.sensor,
    )
    fitted = greybox.train(greybox.build(added, context), trajectories, context, method)
    return replace(model, fitted=fitted)


def balances(config: Config, trajectories: Sequence[Trajectory], context: Context) -> Physics:
    """Make the equations, with ranges from the records and the names of the signals."""
    found = _Balances(config, context, _effects(trajectories))
    for k in range(context.ny):
        values = np.concatenate([t.y[:, k] for t in trajectories])
        found.add(k, float(values.min()), float(np.ptp(values)) or 1.0)
    return Physics(
        states=tuple(found.dynamics),
        dynamics=found.dynamics,
        parameters=found.parameters,
        constants=found.constants(trajectories),
        observation=found.observation,
        bounds={name: Bounds(min=0.0) for name in found.dynamics},
    )


def _renamed(context: Context) -> Context:
    """Rename signals so that their names are plain and not taken, as equations require."""
    inputs = tuple(replace(s, name=f"u{j}") for j, s in enumerate(context.inputs))
    outputs = tuple(replace(s, name=f"y{k}") for k, s in enumerate(context.outputs))
    return replace(context, inputs=inputs, outputs=outputs)


class _Balances:
    """Parts of the equations, output by output."""

    def __init__(self, config: Config, context: Context, signs: Array) -> None:
        self._config, self._context, self._signs = config, context, signs
        self.dynamics: dict[str, str] = {}
        self.observation: dict[str, str] = {}
        self.parameters: dict[str, ParameterRange] = {}

    def constants(self, trajectories: Sequence[Trajectory]) -> dict[str, float]:
        """Least value and width of each input."""
        u = np.concatenate([t.u for t in trajectories])
        found: dict[str, float] = {}
        for j in range(u.shape[1]):
            found[f"low{j}"] = float(u[:, j].min())
            found[f"width{j}"] = float(np.ptp(u[:, j])) or 1.0
        return found

    def add(self, k: int, low: float, span: float) -> None:
        """Add the storages of output k, which goes from `low` up over `span`."""
        names = [f"x{k}_{i}" for i in range(self._config.count)]
        slow, fast = (rate / self._context.sampling_time for rate in _RATES)
        arrives = self._inflow(k, slow, fast)
        for i, name in enumerate(names):
            leaves = self._run_off(f"{k}_{i}", name, slow, fast)
            self.dynamics[name] = f"{arrives} - {leaves}"
            if i + 1 < len(names):
                self.parameters[f"gain{k}_{i}"] = ParameterRange(0.3, 3.0)
            arrives = f"gain{k}_{i}*{leaves}"
        self.parameters[f"zero{k}"] = ParameterRange(low - _BELOW * span, low)
        output = self._context.outputs[k].name
        self.observation[output] = f"zero{k} + {span!r}*{names[-1]}"

    def _inflow(self, k: int, slow: float, fast: float) -> str:
        terms: list[str] = []
        for j, signal in enumerate(self._context.inputs):
            seen = f"({signal.name} - low{j})/width{j}"
            sign = self._signs[j, k]
            name = f"inflow{k}_{j}"
            self.parameters[name] = ParameterRange(slow, _LARGEST_GAIN * fast)
            terms.append(f"{name}*{seen}" if sign >= 0 else f"{name}*(1 - {seen})")
        self.parameters[f"rest{k}"] = ParameterRange(0.0, 0.1 * fast)
        return " + ".join([*terms, f"rest{k}"])

    def _run_off(self, label: str, state: str, slow: float, fast: float) -> str:
        rate = f"rate_{label}"
        self.parameters[rate] = ParameterRange(slow, fast)
        if self._config.outflow == "linear":
            return f"{rate}*{state}"
        if self._config.outflow == "root":
            return f"{rate}*sqrt({state})"
        power = f"power_{label}"
        self.parameters[power] = ParameterRange(*_EXPONENTS)
        return f"{rate}*exp({power}*log({state} + {_EMPTY!r}))"


def _effects(trajectories: Sequence[Trajectory]) -> Array:
    """Signs (nu, ny) of the effects of the inputs.

    The change of an output over a segment of samples is regressed on its initial value and on the
    mean
    inputs in between.
    """
    total = np.zeros((trajectories[0].u.shape[1], trajectories[0].y.shape[1]))
    for ahead in _LOOK_AHEAD:
        rows, changes = list[Array](), list[Array]()
        for t in trajectories:
            if len(t.y) <= ahead:
                continue
            sums = np.cumsum(np.concatenate([np.zeros((1, t.u.shape[1])), t.u]), axis=0)
            means = (sums[ahead:-1] - sums[: -1 - ahead]) / ahead
            known = (t.measured[ahead:] & t.measured[:-ahead]).all(axis=1)
            row = np.concatenate([means, t.y[:-ahead], np.ones((len(means), 1))], axis=1)
            rows.append(row[known])
            changes.append((t.y[ahead:] - t.y[:-ahead])[known])
        if rows:
            theta = np.linalg.lstsq(np.concatenate(rows), np.concatenate(changes), rcond=None)[0]
            total += np.sign(theta[: len(total)])
    return np.where(total < 0, -1.0, 1.0)
