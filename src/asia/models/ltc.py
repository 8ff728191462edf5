"""Liquid time-constant network in closed form.

h[k] = a h[k-1] + (1 - a) f(h[k-1], u[k]),  a = exp(-1 / tau), with a learned time constant tau
(in samples) for each state, f a two-layer tanh network, and an output linear in h and u.
Source: Hasani et al., Closed-form continuous-time neural networks, Nature Machine Intelligence 4,
2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.errors import UserError
from asia.models._network import (
    NetworkModel,
    dense,
    linear_output,
    train_network,
    window_size,
    zeros,
)
from asia.models.methods import Adam
from asia.problem import Trajectory


@dataclass(frozen=True)
class Config:
    """hidden: states; width: units of the inner layer of f and of the initial-state network, None
    for as many as states; tau_min, tau_max: first and last of the log-spaced initial time
    constants, in samples."""

    hidden: int = 64
    width: int | None = None
    tau_min: float = 1.0
    tau_max: float = 25.0

    def __post_init__(self) -> None:
        if self.hidden < 1 or (self.width is not None and self.width < 1):
            raise UserError("ltc.Config: hidden and width must be at least 1")
        if not 0 < self.tau_min <= self.tau_max:
            raise UserError("ltc.Config: expected 0 < tau_min <= tau_max")


@dataclass(frozen=True)
class LTCCell:
    """Structure of the network: see `asia.models._network.Cell`."""

    config: Config

    def initial(self, params: Any, window: jax.Array) -> jax.Array:
        """h before the first sample."""
        inner = jnp.tanh(window @ params["enc_w1"] + params["enc_b1"])
        return jnp.tanh(inner @ params["enc_w2"] + params["enc_b2"])

    def step(self, params: Any, state: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Each state decays towards f with its own time constant."""
        decay = jnp.exp(-jnp.exp(-params["log_tau"]))
        inner = jnp.tanh(state @ params["f_h"] + u @ params["f_u"] + params["f_b1"])
        target = jnp.tanh(inner @ params["f_w2"] + params["f_b2"])
        state = decay * state + (1 - decay) * target
        return state, state

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in h and u."""
        return linear_output(params, features, u)


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    rng = np.random.default_rng(context.seed)
    hidden, width = config.hidden, config.width or config.hidden
    params = {
        "enc_w1": dense(rng, window_size(context), width),
        "enc_b1": zeros(width),
        "enc_w2": dense(rng, width, hidden),
        "enc_b2": zeros(hidden),
        "f_h": dense(rng, hidden, width),
        "f_u": dense(rng, context.nu, width),
        "f_b1": zeros(width),
        "f_w2": dense(rng, width, hidden),
        "f_b2": zeros(hidden),
        "log_tau": np.linspace(np.log(config.tau_min), np.log(config.tau_max), hidden).astype(
            np.float32
        ),
        "out_w": zeros(hidden + context.nu, context.ny),
        "out_b": zeros(context.ny),
    }
    return NetworkModel(LTCCell(config), params)


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: Adam
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(model, trajectories, context, method)
