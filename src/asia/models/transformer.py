"""Causal Transformer over a token of the past window and one token a sample.

A sample attends to itself and to the `span` - 1 tokens before it, with a learned bias for each
distance, so that nothing depends on the absolute position: a model trained on short chunks
simulates records of any length, at a cost that grows with length times span. Sources: Vaswani et
al., NeurIPS 2017; Beltagy, Peters and Cohan, arXiv 2004.05150, 2020 (window in blocks); Press,
Smith and Lewis, ICLR 2022 (the biases at the start).
"""

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, gelu, namespace, softmax, split
from asia.models._config import check_at_least, demand
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    drive_size,
    mlp,
    mlp_params,
    normalised,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


# Score offset that masks a token.
_UNSEEN = -1e9


@dataclass(frozen=True)
class Config:
    """Number and size of the layers, and their reach into the past."""

    layers: int = 2
    """Layers of attention and static network."""
    heads: int = 4
    """Attentions side by side in a layer."""
    width: int = 32
    """Channels between layers, a multiple of `heads`."""
    inner: int = 64
    """Units of the static network of a layer."""
    span: int = 64
    """Tokens that a sample attends to, its own included."""
    encoder: int = 32
    """Units of the network that makes the token of the past window."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "layers", "heads", "width", "inner", "encoder")
        check_at_least(2, self, "span")
        demand(self, "width", self.width % self.heads == 0, "a multiple of heads")
        check_features(self)


@dataclass(frozen=True)
class Transformer(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.FeatureMap`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu = drive_size(c.features, context.nu)
        # Heads look from a few samples back to the whole span.
        reach = np.geomspace(2.0, c.span, c.heads)
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, c.width)),
            "in": mlp_params(rng, (nu, c.width, c.width)),
            "layers": [
                {
                    "gain1": np.ones(c.width, np.float32),
                    "gain2": np.ones(c.width, np.float32),
                    "qkv": dense(rng, c.width, 3 * c.width),
                    "merge": dense(rng, c.width, c.width),
                    "bias": (-np.arange(c.span) / reach[:, None]).astype(np.float32),
                    "w1": dense(rng, c.width, c.inner),
                    "b1": zeros(c.inner),
                    "w2": dense(rng, c.inner, c.width),
                    "b2": zeros(c.width),
                }
                for _ in range(c.layers)
            ],
            "out_w": zeros(c.width + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Channels of the last layer at the samples."""
        c, samples, xp = self.config, u.shape[1], namespace(u)
        token = mlp(params["encoder"], window)[:, None]
        x = xp.concatenate([token, mlp(params["in"], self.drive(u))], axis=1)
        x = xp.pad(x, ((0, 0), (0, -(samples + 1) % c.span), (0, 0)))
        for p in params["layers"]:
            seen = banded_attention(p, normalised(x, p["gain1"]), c.heads, c.span)
            x = _layer_output(p, x, seen)
        return x[:, 1 : samples + 1]

    def begin(self, params: Any, window: AnyArray) -> Any:
        """Keys and values of the tokens before the first sample, and a mask of those that exist."""
        xp, c, batch = namespace(window), self.config, len(window)
        blank = xp.zeros((batch, c.span - 1, c.width), window.dtype)
        unseen = xp.zeros((batch, c.span - 1), window.dtype)
        nothing = [(blank, blank, unseen) for _ in range(c.layers)]
        return self._token(params, nothing, mlp(params["encoder"], window))[0]

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one token."""
        return self._token(params, state, mlp(params["in"], self.drive(u)))

    def _token(self, params: Any, state: Any, x: AnyArray) -> tuple[Any, AnyArray]:
        after = list[Any]()
        for p, held in zip(params["layers"], state, strict=True):
            held, seen = _attended(p, normalised(x, p["gain1"]), held, self.config.heads)
            after.append(held)
            x = _layer_output(p, x, seen)
        return after, x


def _layer_output(p: Any, x: AnyArray, seen: AnyArray) -> AnyArray:
    x = x + seen @ p["merge"]
    inner = gelu(normalised(x, p["gain2"]) @ p["w1"] + p["b1"])
    return x + inner @ p["w2"] + p["b2"]


def _attended(p: Any, x: AnyArray, held: Any, heads: int) -> tuple[Any, AnyArray]:
    """Apply `banded_attention` to one token x (B, width), with the tokens held before it."""
    xp, (batch, width) = namespace(x), x.shape
    query, key, value = split(x @ p["qkv"], 3)
    news = key[:, None], value[:, None], xp.ones((batch, 1), x.dtype)
    keys, values, known = (xp.concatenate(p, axis=1) for p in zip(held, news, strict=True))
    span, size = keys.shape[1], width // heads
    shape = (batch, span, heads, size)
    scores = (query.reshape(batch, 1, heads, size) / sqrt(size) * keys.reshape(shape)).sum(axis=-1)
    bias = p["bias"][:, ::-1].T + _UNSEEN * (1.0 - known)[..., None]
    weights = softmax((scores + bias).swapaxes(1, 2)).swapaxes(1, 2)
    seen = (weights[..., None] * values.reshape(shape)).sum(axis=1).reshape(batch, width)
    return (keys[:, 1:], values[:, 1:], known[:, 1:]), seen


def banded_attention(p: Any, x: AnyArray, heads: int, span: int) -> AnyArray:
    """Attend in blocks: x (B, T, width), T a multiple of span -> (B, T, width).

    Each block of `span` tokens looks at itself and at the block before it.
    """
    xp, (batch, length, width) = namespace(x), x.shape
    shape = (batch, length // span, span, heads, width // heads)
    # (B, blocks, heads, tokens, channels)
    parts = [part.reshape(shape).swapaxes(2, 3) for part in split(x @ p["qkv"], 3)]
    query, keys, values = parts[0], _with_block_before(parts[1]), _with_block_before(parts[2])
    scores = (query / sqrt(width // heads)) @ keys.swapaxes(-1, -2)
    distance = np.arange(span)[:, None] + span - np.arange(2 * span)
    near = (distance >= 0) & (distance < span)
    bias = xp.where(near, p["bias"][:, np.clip(distance, 0, span - 1)], _UNSEEN)
    nothing_before = np.zeros((length // span, 1, 1, 2 * span), x.dtype)
    nothing_before[0, ..., :span] = _UNSEEN
    weights = softmax(scores + bias + nothing_before)
    return (weights @ values).swapaxes(2, 3).reshape(batch, length, width)


def _with_block_before(x: AnyArray) -> AnyArray:
    xp = namespace(x)
    before = xp.pad(x, ((0, 0), (1, 0), (0, 0), (0, 0), (0, 0)))[:, :-1]
    return xp.concatenate([before, x], axis=3)


build, train = network_family(Config, Transformer)
