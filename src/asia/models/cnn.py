"""Temporal convolutional network: dilated causal convolutions over the inputs.

Blocks of gated convolutions with dilations 1, 2, 4, ... see `receptive_field` samples back. What
the past window tells enters as channels that start from a learned function of it and decay, each
with its own learned time constant, so that the model reaches further back than its convolutions
there. Sources: Bai, Kolter and Koltun, arXiv 1803.01271, 2018; Andersson et al., Deep convolutional
networks in system identification, CDC 2019; van den Oord et al., arXiv 1609.03499, 2016 (gates).
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
from asia.models._networks.layers import decaying, log_spaced, mlp, mlp_params
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
    """receptive_field: samples of input that an output depends on, at least; width: channels;
    kernel: taps a convolution; memory: channels that carry the past window, with initial time
    constants log-spaced from 1 to the receptive field; encoder: units of the network that fills
    them; features: functions of the inputs, see `asia.models._data.features`."""

    receptive_field: int = 128
    width: int = 16
    kernel: int = 3
    memory: int = 16
    encoder: int = 32
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.width, self.memory, self.encoder) < 1:
            raise UserError("cnn.Config: width, memory and encoder must be at least 1")
        if self.kernel < 2 or self.receptive_field < 2:
            raise UserError("cnn.Config: kernel and receptive_field must be at least 2")
        check_features(self.features, "cnn.Config")

    @property
    def dilations(self) -> tuple[int, ...]:
        """1, 2, 4, ...: as many as the receptive field takes."""
        found = [1]
        while 1 + (self.kernel - 1) * sum(found) < self.receptive_field:
            found.append(2 * found[-1])
        return tuple(found)


@dataclass(frozen=True)
class ConvolutionStack(Driven):
    """Structure of the network: see `asia.models._networks.network.FeatureMap`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        inputs = drive_size(c.features, context.nu) + c.memory
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, c.memory)),
            "log_tau": log_spaced(1.0, c.receptive_field, c.memory),
            "in": mlp_params(rng, (inputs, c.width)),
            "blocks": [_block_params(rng, c) for _ in c.dilations],
            "out_w": zeros(c.width + c.memory + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """Last block's channels and the memory of the past window."""
        memory = decaying(mlp(params["encoder"], window), params["log_tau"], u.shape[1])
        x = mlp(params["in"], jnp.concatenate([self.drive(u), memory], axis=-1))
        for p, dilation in zip(params["blocks"], self.config.dilations, strict=True):
            taps = [_late(x, dilation * i) for i in range(self.config.kernel)]
            value, gate = jnp.split(jnp.concatenate(taps, -1) @ p["taps"] + p["b1"], 2, axis=-1)
            x = x + (jnp.tanh(value) * jax.nn.sigmoid(gate)) @ p["w2"] + p["b2"]
        return jnp.concatenate([x, memory], axis=-1)

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in the features and in u."""
        return linear_output(params, features, u)


def _late(x: jax.Array, samples: int) -> jax.Array:
    """x (B, T, channels) delayed, zero before the first sample."""
    return jnp.pad(x, ((0, 0), (samples, 0), (0, 0)))[:, : x.shape[1]]


def _block_params(rng: np.random.Generator, c: Config) -> dict[str, Any]:
    return {
        "taps": dense(rng, c.kernel * c.width, 2 * c.width),
        "b1": zeros(2 * c.width),
        "w2": dense(rng, c.width, c.width),
        "b2": zeros(c.width),
    }


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = ConvolutionStack(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(with_drive(model, trajectories), trajectories, context, method)
