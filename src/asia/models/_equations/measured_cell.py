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

import jax
import jax.numpy as jnp
import numpy as np

from asia.data import Array, Trajectory
from asia.models import recurrent
from asia.models._equations.config import Range
from asia.models._equations.ode import Equations
from asia.models._equations.simulate import physical_parameters

NetworkKind = Literal["mlp", "rnn", "gru", "lstm"]

# A simulation beyond so many deviations of a state has run away.
_FAR = 30.0
# Network inputs are bounded to this many deviations: beyond, its output stays that at the bound.
_REACH = 3.0


class MeasuredState(NamedTuple):
    """x (B, nx) states, m (B, nu) inputs behind their lag, d (B, nd) disturbance, h: of the
    network, first (B, 1): whether no sample has been simulated yet."""

    x: jax.Array
    m: jax.Array
    d: jax.Array
    h: Any
    first: jax.Array


@dataclass(frozen=True)
class MeasuredCell:
    """Structure of the model: see `asia.models._networks.structure.Cell`. Hashable.

    order: the output that is each state; dynamic, kinematic: indices of the equations with and
    without free parameters; read: names of the states and definitions the learned terms may read.
    """

    equations: Equations
    ranges: tuple[Range, ...]
    order: tuple[int, ...]
    dynamic: tuple[int, ...]
    kinematic: tuple[int, ...]
    read: tuple[str, ...]
    sampling_time: float
    past_inputs: bool
    lag: bool
    linear: bool
    disturbance: bool
    network: NetworkKind | None
    inner: recurrent.Config | None
    size: float

    @property
    def nd(self) -> int:
        """Number of equations with learned terms."""
        return len(self.dynamic)

    @property
    def net_inputs(self) -> int:
        """Signals the network reads: those of `read`, the inputs and the equations' rates."""
        return len(self.read) + len(self.equations.inputs) + self.nd

    def physical(self, z: jax.Array) -> jax.Array:
        """Physical parameters (np,) from coordinates in which [-1, 1] spans their ranges."""
        return physical_parameters(self.ranges, z)

    def initial(self, params: Any, window: jax.Array) -> MeasuredState:
        """From the last measured outputs, and the last measured inputs where there are any."""
        fixed = params["fixed"]
        ny, nu = len(self.order), len(self.equations.inputs)
        y = window[:, window.shape[1] - ny :] * fixed["y_std"] + fixed["y_mean"]
        x = y[:, jnp.array(self.order)]
        batch = x.shape[0]
        m = jnp.zeros((batch, nu), x.dtype)
        if self.past_inputs:
            last = window.shape[1] - ny - nu
            m = window[:, last : last + nu] * fixed["u_std"] + fixed["u_mean"]
        h: Any = ()
        if self.inner is not None:
            zero = jnp.zeros((batch, self.inner.hidden), x.dtype)
            h = [(zero, zero) for _ in range(self.inner.layers)]
        return MeasuredState(
            x, m, jnp.zeros((batch, self.nd), x.dtype), h, jnp.ones((batch, 1), bool)
        )

    def step(
        self, params: Any, state: MeasuredState, u: jax.Array
    ) -> tuple[MeasuredState, jax.Array]:
        """What the output is read from is the output, z-scored."""
        fixed, dt = params["fixed"], self.sampling_time
        u = u * fixed["u_std"] + fixed["u_mean"]
        m = u
        if self.lag:
            before = state.m if self.past_inputs else jnp.where(state.first, u, state.m)
            m = before + (1.0 - jnp.exp(-dt / jnp.exp(params["log_lag"]))) * (u - before)
        p = self.physical(params["physical"])

        def rates(x: jax.Array) -> jax.Array:
            return jax.vmap(lambda a, b: self.equations.derivative(p, a, b))(x, m)

        known, dynamic = rates(state.x), jnp.array(self.dynamic)
        learned, d, h = self._learned(params, p, state, m, known)
        gain = jnp.ones(known.shape[1], known.dtype)
        if self.kinematic:
            gain = gain.at[jnp.array(self.kinematic)].set(1.0 + params["gain"])
        extra = jnp.zeros_like(known).at[:, dynamic].set(learned)
        middle = state.x + 0.5 * dt * (gain * known + extra)
        x = state.x + dt * (gain * rates(middle) + extra)
        x = jnp.where(jnp.isfinite(x), x, state.x)
        x = jnp.clip(x, fixed["x_low"], fixed["x_high"])
        y = (jnp.zeros_like(x).at[:, jnp.array(self.order)].set(x) - fixed["y_mean"]) / fixed[
            "y_std"
        ]
        return MeasuredState(x, m, d, h, jnp.zeros_like(state.first)), y

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """The features."""
        del params, u
        return features

    def feed(
        self, params: Any, state: MeasuredState, y: jax.Array, mask: jax.Array
    ) -> MeasuredState:
        """The state with its outputs replaced by the measured ones, z-scored, where the mask is
        1."""
        fixed = params["fixed"]
        measured = (y * fixed["y_std"] + fixed["y_mean"])[:, jnp.array(self.order)]
        return state._replace(x=mask * measured + (1 - mask) * state.x)

    def signals(self, params: Any, p: jax.Array, x: jax.Array, m: jax.Array) -> jax.Array:
        """Normalised signals (B, len(read))."""
        values = jax.vmap(lambda a, b: self.equations.named(self.read, p, a, b))(x, m)
        return (values - params["fixed"]["s_mean"]) / params["fixed"]["s_std"]

    def _learned(
        self, params: Any, p: jax.Array, state: MeasuredState, m: jax.Array, known: jax.Array
    ) -> tuple[jax.Array, jax.Array, Any]:
        """Learned rates (B, nd), next disturbance, next state of the network."""
        fixed = params["fixed"]
        total = known[:, jnp.array(self.dynamic)] / fixed["rate"]
        signals = self.signals(params, p, state.x, m)
        extra = jnp.zeros_like(total)
        if self.linear:
            extra = extra + params["offset"] + signals @ params["linear"]
        d, h = state.d, state.h
        if self.network is not None:
            inputs = (m - fixed["u_mean"]) / fixed["u_std"]
            v = jnp.concatenate([signals, inputs, total + extra], axis=-1)
            v = _REACH * jnp.tanh(v / _REACH)
            if self.network == "mlp":
                net = params["net"]
                v = jnp.tanh(jnp.tanh(v @ net["w1"] + net["b1"]) @ net["w2"] + net["b2"])
            else:
                assert self.inner is not None
                h, v = recurrent.RecurrentCell(self.inner).step(params["net"], h, v)
            extra = extra + self.size * (v @ params["out_w"] + params["out_b"])
        if self.disturbance:
            bound = jnp.exp(params["d_bound"])
            d = jnp.where(state.first, -params["d_start"] * (total + extra), d)
            extra = extra + bound * jnp.tanh(d / bound)
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
    with jax.enable_x64(True):
        p = cell.physical(jnp.zeros(len(cell.ranges)))
        values = np.asarray(
            jax.vmap(lambda a, b: cell.equations.named(cell.read, p, a, b))(
                jnp.asarray(y), jnp.asarray(u)
            )
        )
    std = values.std(axis=0)
    return values.mean(axis=0), np.where(std > 0, std, 1.0)
