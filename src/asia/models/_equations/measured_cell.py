"""Equations whose states are all measured, with learned terms: one sample's step, batch first.

    dx/dt = gain f(x, m) + gain rate (offset + linear' s + d + net),   dm/dt = (u - m) / lag

The learned terms act on the equations with free parameters; gain is 1 + `gain` in the others
(known kinematics) and 1 in these. s are normalised states and definitions that the
equations read; d, bounded, is a disturbance that opposes the acceleration at the start and then
the mean acceleration; net is a network. Everything learned is without effect at zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from asia.data import Array, Trajectory
from asia.models import recurrent
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.config import Range
from asia.models._equations.ode import Equations
from asia.models._equations.simulate import physical_parameters

NetworkKind = Literal["mlp", "rnn", "gru", "lstm"]

# A simulation beyond so many deviations of a state has run away.
_FAR = 30.0
# Network inputs are bounded to this many deviations: beyond, its output stays that at the bound.
_REACH = 3.0


class MeasuredState(NamedTuple):
    """Before a sample."""

    x: AnyArray
    """States (B, nx)."""
    m: AnyArray
    """Inputs behind their lag (B, nu)."""
    d: AnyArray
    """Disturbance (B, nd)."""
    h: Any
    """State of the network."""
    first: AnyArray
    """Whether no sample has been simulated yet (B, 1)."""


@dataclass(frozen=True)
class MeasuredCell:
    """Structure of the model: see `asia.models._networks.structure.Cell`. Hashable."""

    equations: Equations
    """The person's."""
    ranges: tuple[Range, ...]
    """Of their parameters."""
    order: tuple[int, ...]
    """The output that is each state."""
    dynamic: tuple[int, ...]
    """Equations with free parameters."""
    kinematic: tuple[int, ...]
    """Equations without, where these get a gain; else none."""
    read: tuple[str, ...]
    """States and definitions that the learned terms may read."""
    sampling_time: float
    """In s."""
    past_inputs: bool
    """Whether a past window shows inputs."""
    lag: bool
    """Whether the inputs act through a lag."""
    linear: bool
    """Whether there are linear terms."""
    disturbance: bool
    """Whether there is a disturbance state."""
    network: NetworkKind | None
    """Kind of the network, if there is one."""
    inner: recurrent.Config | None
    """Its layers, where it is recurrent."""
    size: float
    """Its largest effect, as a share of the rates measured."""

    @property
    def nd(self) -> int:
        """Number of equations with learned terms."""
        return len(self.dynamic)

    @property
    def net_inputs(self) -> int:
        """Signals the network reads: those of `read`, the inputs and the equations' rates."""
        return len(self.read) + len(self.equations.inputs) + self.nd

    def physical(self, z: AnyArray) -> AnyArray:
        """Physical parameters (np,) from coordinates in which [-1, 1] spans their ranges."""
        return physical_parameters(self.ranges, z)

    def initial(self, params: Any, window: AnyArray) -> MeasuredState:
        """From the last measured outputs, and the last measured inputs where there are any."""
        fixed, xp = params["fixed"], namespace(window)
        ny, nu = len(self.order), len(self.equations.inputs)
        y = window[:, window.shape[1] - ny :] * fixed["y_std"] + fixed["y_mean"]
        x = y[:, np.array(self.order)]

        def zeros(columns: int) -> AnyArray:
            return xp.zeros((len(x), columns), x.dtype)

        m = zeros(nu)
        if self.past_inputs:
            last = window.shape[1] - ny - nu
            m = window[:, last : last + nu] * fixed["u_std"] + fixed["u_mean"]
        h: Any = ()
        if self.inner is not None:
            h = [(zeros(self.inner.hidden),) * 2 for _ in range(self.inner.layers)]
        return MeasuredState(x, m, zeros(self.nd), h, xp.ones((len(x), 1), bool))

    def step(
        self, params: Any, state: MeasuredState, u: AnyArray
    ) -> tuple[MeasuredState, AnyArray]:
        """What the output is read from is the output, z-scored."""
        fixed, dt, xp = params["fixed"], self.sampling_time, namespace(u)
        u = u * fixed["u_std"] + fixed["u_mean"]
        m = u
        if self.lag:
            before = state.m if self.past_inputs else xp.where(state.first, u, state.m)
            m = before + (1.0 - xp.exp(-dt / xp.exp(params["log_lag"]))) * (u - before)
        p = self.physical(params["physical"])
        evaluate, inputs = self.equations.rates(xp, u.dtype), m.T

        def rates(x: AnyArray) -> AnyArray:
            return evaluate(p, x.T, inputs).T

        known = rates(state.x)
        learned, d, h = self._learned(params, p, state, m, known)
        extra = self._in_order(xp.zeros_like(known[:, self.nd :]), learned)
        gain: AnyArray = 1.0
        if self.kinematic:
            gain = self._in_order(1.0 + params["gain"], xp.ones_like(learned[0]))
        middle = state.x + 0.5 * dt * (gain * known + extra)
        x = state.x + dt * (gain * rates(middle) + extra)
        x = xp.where(xp.isfinite(x), x, state.x)
        x = xp.minimum(xp.maximum(x, fixed["x_low"]), fixed["x_high"])
        y = (x[:, np.argsort(self.order)] - fixed["y_mean"]) / fixed["y_std"]
        return MeasuredState(x, m, d, h, xp.zeros_like(state.first)), y

    def _in_order(self, others: AnyArray, dynamic: AnyArray) -> AnyArray:
        """Values (..., nx) in the order of the states, from those of the other equations (in their
        order) and of the dynamic ones."""
        nx = len(self.order)
        places = [*(i for i in range(nx) if i not in self.dynamic), *self.dynamic]
        together = namespace(others, dynamic).concatenate([others, dynamic], axis=-1)
        return together[..., np.argsort(places)]

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """The features."""
        del params, u
        return features

    def feed(self, params: Any, state: MeasuredState, y: AnyArray, mask: AnyArray) -> MeasuredState:
        """The state with its outputs replaced by the measured ones, z-scored, where the mask is
        1."""
        fixed = params["fixed"]
        measured = (y * fixed["y_std"] + fixed["y_mean"])[:, np.array(self.order)]
        return state._replace(x=mask * measured + (1 - mask) * state.x)

    def signals(self, params: Any, p: AnyArray, x: AnyArray, m: AnyArray) -> AnyArray:
        """Normalised signals (B, len(read))."""
        values = self.equations.named(self.read, p, x.T, m.T).T
        return (values - params["fixed"]["s_mean"]) / params["fixed"]["s_std"]

    def _learned(
        self, params: Any, p: AnyArray, state: MeasuredState, m: AnyArray, known: AnyArray
    ) -> tuple[AnyArray, AnyArray, Any]:
        """Learned rates (B, nd), next disturbance, next state of the network."""
        fixed, xp = params["fixed"], namespace(known)
        total = known[:, np.array(self.dynamic, int)] / fixed["rate"]
        signals = self.signals(params, p, state.x, m)
        extra = xp.zeros_like(total)
        if self.linear:
            extra = extra + params["offset"] + signals @ params["linear"]
        d, h = state.d, state.h
        if self.network is not None:
            inputs = (m - fixed["u_mean"]) / fixed["u_std"]
            v = xp.concatenate([signals, inputs, total + extra], axis=-1)
            v = _REACH * xp.tanh(v / _REACH)
            if self.network == "mlp":
                net = params["net"]
                v = xp.tanh(xp.tanh(v @ net["w1"] + net["b1"]) @ net["w2"] + net["b2"])
            else:
                assert self.inner is not None
                h, v = recurrent.RecurrentCell(self.inner).step(params["net"], h, v)
            extra = extra + self.size * (v @ params["out_w"] + params["out_b"])
        if self.disturbance:
            bound = xp.exp(params["d_bound"])
            d = xp.where(state.first, -params["d_start"] * (total + extra), d)
            extra = extra + bound * xp.tanh(d / bound)
            pull = params["d_gain"] * (total + extra) + params["d_decay"] * d
            d = d - self.sampling_time * pull
        return extra * fixed["rate"], d, h


def limits(mean: Any, std: Any) -> tuple[Any, Any]:
    """Bounds (nx,) that keep a simulation finite."""
    return mean - _FAR * std, mean + _FAR * std


def signal_sizes(cell: MeasuredCell, trajectories: Sequence[Trajectory]) -> tuple[Array, Array]:
    """Mean and standard deviation, (n,) each, of the signals that the equations read."""
    every = max(1, sum(len(t) for t in trajectories) // 2000)
    y = np.concatenate([t.y[::every] for t in trajectories])[:, list(cell.order)]
    u = np.concatenate([t.u[::every] for t in trajectories])
    p = cell.physical(np.zeros(len(cell.ranges)))
    values = cell.equations.named(cell.read, p, y.T, u.T).T
    std = values.std(axis=0)
    return values.mean(axis=0), np.where(std > 0, std, 1.0)
