"""Linear recurrent units: stable linear systems in diagonal form between static networks.

Each layer is x[k] = pole x[k-1] + B v[k] with complex poles inside the unit circle whatever the
parameters, then a gated unit of Re(C x) + D v, added to what came in. A layer's states before the
first sample come from the past window. Source: Orvieto et al., Resurrecting recurrent neural
networks for long sequences, ICML 2023.
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
from asia.models._networks.layers import diagonal_states, gated, log_spaced, mlp, mlp_params, poles
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
    """layers; states: complex states a layer; width: channels between layers; encoder: units of
    the initial-state network; tau_max: slowest of the log-spaced initial time constants, in
    samples, the fastest being 1; angle_max: largest initial rotation a sample, in rad; features:
    functions of the inputs, see `asia.models._data.features`."""

    layers: int = 2
    states: int = 16
    width: int = 16
    encoder: int = 32
    tau_max: float = 100.0
    angle_max: float = 0.5
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.layers, self.states, self.width, self.encoder) < 1:
            raise UserError("lru.Config: layers, states, width and encoder must be at least 1")
        if self.tau_max < 1 or not 0 <= self.angle_max <= np.pi:
            raise UserError("lru.Config: expected tau_max >= 1 and angle_max in [0, pi]")
        check_features(self.features, "lru.Config")


@dataclass(frozen=True)
class LRUStack(Driven):
    """Structure of the network: see `asia.models._networks.network.FeatureMap`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu, states = drive_size(c.features, context.nu), 2 * c.layers * c.states
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, states)),
            "in": mlp_params(rng, (nu, c.width, c.width)),
            "layers": [_layer_params(rng, c) for _ in range(c.layers)],
            "out_w": zeros(c.width + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """What the last layer gives."""
        x = mlp(params["in"], self.drive(u))
        starts = jnp.split(mlp(params["encoder"], window), 2 * self.config.layers, axis=-1)
        for i, p in enumerate(params["layers"]):
            x = x + _layer(p, x, jax.lax.complex(starts[2 * i], starts[2 * i + 1]))
        return x

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in the last layer's channels and in u."""
        return linear_output(params, features, u)


def _layer(p: Any, v: jax.Array, start: jax.Array) -> jax.Array:
    pole, gain = poles(p["log_rate"], p["angle"])
    drive = jax.lax.complex(gain * (v @ p["b_re"]), gain * (v @ p["b_im"]))
    x = diagonal_states(pole, drive, start)
    y = jnp.real(x) @ p["c_re"] - jnp.imag(x) @ p["c_im"] + v * p["d"]
    return gated(jax.nn.gelu(y), p["gate_w"], p["gate_b"])


def _layer_params(rng: np.random.Generator, c: Config) -> dict[str, Any]:
    half = float(np.sqrt(0.5))
    return {
        "log_rate": -log_spaced(1.0, c.tau_max, c.states),
        "angle": rng.uniform(0.0, c.angle_max, c.states).astype(np.float32),
        "b_re": dense(rng, c.width, c.states, half),
        "b_im": dense(rng, c.width, c.states, half),
        "c_re": dense(rng, c.states, c.width),
        "c_im": dense(rng, c.states, c.width),
        "d": rng.standard_normal(c.width).astype(np.float32),
        "gate_w": dense(rng, c.width, 2 * c.width),
        "gate_b": zeros(2 * c.width),
    }


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = LRUStack(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(with_drive(model, trajectories), trajectories, context, method)
