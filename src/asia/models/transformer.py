"""Causal Transformer over a token of the past window and one token a sample.

A sample attends to itself and to the `span` - 1 tokens before it, with a learned bias for each
distance, so that nothing depends on the absolute position: a model trained on short chunks
simulates records of any length, at a cost that grows with length times span. Sources: Vaswani et
al., NeurIPS 2017; Beltagy, Peters and Cohan, arXiv 2004.05150, 2020 (window in blocks); Press,
Smith and Lewis, ICLR 2022 (the biases at the start).
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
from asia.models._networks.layers import mlp, mlp_params, normalised
from asia.models._networks.network import (
    Float32,
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
    """layers; heads; width: channels, a multiple of heads; inner: units of the static network in
    a layer; span: tokens an attention sees, itself included; encoder: units of the network that
    makes the past window's token; features: functions of the inputs, see
    `asia.models._data.features`."""

    layers: int = 2
    heads: int = 4
    width: int = 32
    inner: int = 64
    span: int = 64
    encoder: int = 32
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.layers, self.heads, self.width, self.inner, self.encoder) < 1 or self.span < 2:
            raise UserError(
                "transformer.Config: layers, heads, width, inner and encoder must be at least 1, "
                "span at least 2"
            )
        if self.width % self.heads:
            raise UserError(
                f"transformer.Config: width {self.width} is no multiple of heads {self.heads}"
            )
        check_features(self.features, "transformer.Config")


@dataclass(frozen=True)
class Transformer(Driven):
    """Structure of the network: see `asia.models._networks.network.FeatureMap`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu = drive_size(c.features, context.nu)
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, c.width)),
            "in": mlp_params(rng, (nu, c.width, c.width)),
            "layers": [_layer_params(rng, c) for _ in range(c.layers)],
            "out_w": zeros(c.width + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """Last layer's channels of the samples."""
        c, samples = self.config, u.shape[1]
        token = mlp(params["encoder"], window)[:, None]
        x = jnp.concatenate([token, mlp(params["in"], self.drive(u))], axis=1)
        x = jnp.pad(x, ((0, 0), (0, -(samples + 1) % c.span), (0, 0)))
        for p in params["layers"]:
            x = x + banded_attention(p, normalised(x, p["gain1"]), c.heads, c.span) @ p["merge"]
            inner = jax.nn.gelu(normalised(x, p["gain2"]) @ p["w1"] + p["b1"])
            x = x + inner @ p["w2"] + p["b2"]
        return x[:, 1 : samples + 1]

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in the features and in u."""
        return linear_output(params, features, u)


def banded_attention(p: Any, x: jax.Array, heads: int, span: int) -> jax.Array:
    """x (B, T, width), T a multiple of span -> (B, T, width). Each block of `span` tokens looks
    at itself and at the block before it."""
    batch, length, width = x.shape
    shape = (batch, length // span, span, heads, width // heads)
    query, key, value = (part.reshape(shape) for part in jnp.split(x @ p["qkv"], 3, axis=-1))
    keys, values = _with_block_before(key), _with_block_before(value)
    scores = jnp.einsum("bnihd,bnjhd->bnhij", query, keys) / np.sqrt(width // heads)
    distance = np.arange(span)[:, None] + span - np.arange(2 * span)
    seen = np.broadcast_to((distance >= 0) & (distance < span), (shape[1], span, 2 * span)).copy()
    seen[0, :, :span] = False
    bias = p["bias"][:, np.clip(distance, 0, span - 1)]
    weights = jax.nn.softmax(jnp.where(seen[:, None], scores + bias, -1e9), axis=-1)
    return jnp.einsum("bnhij,bnjhd->bnihd", weights, values).reshape(batch, length, width)


def _with_block_before(x: jax.Array) -> jax.Array:
    before = jnp.pad(x, ((0, 0), (1, 0), (0, 0), (0, 0), (0, 0)))[:, :-1]
    return jnp.concatenate([before, x], axis=2)


def _layer_params(rng: np.random.Generator, c: Config) -> dict[str, Any]:
    return {
        "gain1": np.ones(c.width, np.float32),
        "gain2": np.ones(c.width, np.float32),
        "qkv": dense(rng, c.width, 3 * c.width),
        "merge": dense(rng, c.width, c.width),
        "bias": _nearness(c),
        "w1": dense(rng, c.width, c.inner),
        "b1": zeros(c.inner),
        "w2": dense(rng, c.inner, c.width),
        "b2": zeros(c.width),
    }


def _nearness(c: Config) -> Float32:
    """(heads, span): heads that look from a few samples back to the whole span."""
    reach = np.geomspace(2.0, c.span, c.heads)
    return (-np.arange(c.span) / reach[:, None]).astype(np.float32)


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = Transformer(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(with_drive(model, trajectories), trajectories, context, method)
