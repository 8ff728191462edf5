"""Cascade of two liquid time-constant layers, one slow and one fast.

Each layer is h[k] = a h[k-1] + (1 - a) f(h[k-1], v[k]), a = exp(-1 / tau), as in `asia.models.ltc`;
the slow one is driven by the input, the fast one by the slow states and the input, and the output
is linear in both and in the input. A time constant is learned inside its layer's range, so that
the two time scales stay apart. Source: Hasani et al., Closed-form continuous-time neural networks,
Nature Machine Intelligence 4, 2022, for the layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.errors import UserError
from asia.models._data.features import Driven, Features, check_features, drive_size, with_drive
from asia.models._networks.layers import mlp, mlp_params
from asia.models._networks.network import (
    NetworkModel,
    Params,
    dense,
    linear_output,
    train_network,
    window_size,
    zeros,
)
from asia.models.methods import NetworkMethod


@dataclass(frozen=True)
class Config:
    """slow, fast: states of the layers; width: units of the inner layer of each f and of the
    initial-state network; slow_min, slow_max, fast_min, fast_max: ranges of the time constants,
    in samples; features: functions of the inputs, see `asia.models._data.features`."""

    slow: int = 16
    fast: int = 16
    width: int = 32
    slow_min: float = 10.0
    slow_max: float = 200.0
    fast_min: float = 0.5
    fast_max: float = 20.0
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.slow, self.fast, self.width) < 1:
            raise UserError("cascaded_ltc.Config: slow, fast and width must be at least 1")
        for low, high in (self.slow_min, self.slow_max), (self.fast_min, self.fast_max):
            if not 0 < low < high:
                raise UserError(
                    f"cascaded_ltc.Config: time constants from {low} to {high} samples, "
                    "expected 0 < min < max"
                )
        check_features(self.features, "cascaded_ltc.Config")


@dataclass(frozen=True)
class CascadedLTCCell(Driven):
    """Structure of the network: see `asia.models._networks.network.Cell`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu, states = drive_size(c.features, context.nu), c.slow + c.fast
        return {
            "encoder": mlp_params(rng, (window_size(context), c.width, states)),
            "slow": _layer_params(rng, nu, c.slow, c.width),
            "fast": _layer_params(rng, nu + c.slow, c.fast, c.width),
            "out_w": zeros(states + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def initial(self, params: Any, window: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Slow and fast states before the first sample."""
        start = jnp.tanh(mlp(params["encoder"], window))
        return start[:, : self.config.slow], start[:, self.config.slow :]

    def step(
        self, params: Any, state: tuple[jax.Array, jax.Array], u: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        """The fast layer reads the slow states of the same sample."""
        c, u = self.config, self.drive(u)
        slow = _layer(params["slow"], c.slow_min, c.slow_max, state[0], u)
        drive = jnp.concatenate([slow, u], axis=-1)
        fast = _layer(params["fast"], c.fast_min, c.fast_max, state[1], drive)
        return (slow, fast), jnp.concatenate([slow, fast], axis=-1)

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in the states and in u."""
        return linear_output(params, features, u)


def _layer(p: Any, low: float, high: float, h: jax.Array, drive: jax.Array) -> jax.Array:
    decay = jnp.exp(-1.0 / time_constants(p["place"], low, high))
    inner = jnp.tanh(h @ p["h"] + drive @ p["drive"] + p["b1"])
    return decay * h + (1 - decay) * jnp.tanh(inner @ p["w2"] + p["b2"])


def time_constants(place: jax.Array, low: float, high: float) -> jax.Array:
    """In samples, between low and high on a log scale, for parameters of any size."""
    share = jax.nn.sigmoid(place)
    return jnp.exp((1 - share) * jnp.log(low) + share * jnp.log(high))


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = CascadedLTCCell(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(with_drive(model, trajectories), trajectories, context, method)


def _layer_params(rng: np.random.Generator, inputs: int, states: int, width: int) -> dict[str, Any]:
    return {
        "h": dense(rng, states, width),
        "drive": dense(rng, inputs, width),
        "b1": zeros(width),
        "w2": dense(rng, width, states),
        "b2": zeros(states),
        "place": np.linspace(-2.5, 2.5, states).astype(np.float32),
    }
