"""Recurrent networks: vanilla RNN, GRU, LSTM, in layers.

The state before the first sample comes from the past window through a small network; the output
is linear in the last layer's state and in the input. Sources: Cho et al., EMNLP 2014 (GRU);
Hochreiter and Schmidhuber, Neural Computation 9(8), 1997 (LSTM).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.errors import UserError
from asia.models._data.features import Driven, Features, check_features, drive_size, with_drive
from asia.models._networks.network import (
    Float32,
    NetworkModel,
    Params,
    as_built,
    dense,
    linear_output,
    train_network,
    uniform,
    window_size,
    zeros,
)
from asia.models.methods import NetworkMethod

_GATES = {"rnn": 1, "gru": 3, "lstm": 4}


@dataclass(frozen=True)
class Config:
    """cell; hidden: units a layer; layers; encoder: units of the initial-state network.

    activation: that of the network's inner layer; with "relu" its outputs are linear, with "tanh"
    they are bent too. tied: an LSTM's c starts equal to h. direct: whether the output has a linear
    term of the input. start: "ridge" draws orthogonal recurrent weights and gates that remember 1
    to 100 samples and solves the output layer by ridge regression; "uniform" draws everything
    within 1 / sqrt(fan-in), as PyTorch does. features: functions of the inputs that the layers see,
    see `asia.models._data.features`.
    """

    cell: Literal["rnn", "gru", "lstm"] = "gru"
    hidden: int = 32
    layers: int = 1
    encoder: int = 32
    activation: Literal["tanh", "relu"] = "tanh"
    tied: bool = False
    direct: bool = True
    start: Literal["ridge", "uniform"] = "ridge"
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.cell not in _GATES:
            raise UserError(f"recurrent.Config: cell is '{self.cell}', expected rnn, gru or lstm")
        if min(self.hidden, self.layers, self.encoder) < 1:
            raise UserError("recurrent.Config: hidden, layers and encoder must be at least 1")
        if self.activation not in ("tanh", "relu"):
            raise UserError(
                f"recurrent.Config: activation is '{self.activation}', expected tanh or relu"
            )
        if self.start not in ("ridge", "uniform"):
            raise UserError(f"recurrent.Config: start is '{self.start}', expected ridge or uniform")
        check_features(self.features, "recurrent.Config")


@dataclass(frozen=True)
class RecurrentCell(Driven):
    """Structure of the network: see `asia.models._networks.network.Cell`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng = np.random.default_rng(context.seed)
        if self.config.start == "uniform":
            return _uniform_parameters(rng, self.config, context)
        return _parameters(rng, self.config, context)

    def initial(self, params: Any, window: jax.Array) -> Any:
        """One (h, c) for each layer; c is used by the LSTM alone."""
        inner = window @ params["enc_w1"] + params["enc_b1"]
        bend = jnp.tanh if self.config.activation == "tanh" else jax.nn.relu
        start = bend(inner) @ params["enc_w2"] + params["enc_b2"]
        if self.config.activation == "tanh":
            start = jnp.tanh(start)
        if self.config.tied:
            return [(h, h) for h in jnp.split(start, self.config.layers, axis=-1)]
        parts = jnp.split(start, 2 * self.config.layers, axis=-1)
        return [(parts[2 * i], parts[2 * i + 1]) for i in range(self.config.layers)]

    def step(self, params: Any, state: Any, u: jax.Array) -> tuple[Any, jax.Array]:
        """Each layer reads the one below."""
        signal, result = self.drive(u), []
        for layer, (h, c) in zip(params["layers"], state, strict=True):
            h, c = self._layer(layer, h, c, signal)
            result.append((h, c))
            signal = h
        return result, signal

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in the last layer's h and, with `direct`, in u."""
        if not self.config.direct:
            return features @ params["out_w"] + params["out_b"]
        return linear_output(params, features, u)

    def _layer(
        self, p: Any, h: jax.Array, c: jax.Array, u: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        drive = u @ p["u"] + p["b"]
        if self.config.cell == "rnn":
            return jnp.tanh(drive + h @ p["h"]), c
        parts = jnp.split(drive, _GATES[self.config.cell], axis=-1)
        back = jnp.split(h @ p["h"], _GATES[self.config.cell], axis=-1)
        if self.config.cell == "gru":
            reset = jax.nn.sigmoid(parts[0] + back[0])
            keep = jax.nn.sigmoid(parts[1] + back[1])
            return keep * h + (1 - keep) * jnp.tanh(parts[2] + reset * back[2]), c
        write, keep, read, new = (a + b for a, b in zip(parts, back, strict=True))
        c = jax.nn.sigmoid(keep) * c + jax.nn.sigmoid(write) * jnp.tanh(new)
        return jax.nn.sigmoid(read) * jnp.tanh(c), c


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = RecurrentCell(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    random = isinstance(model.cell, RecurrentCell) and model.cell.config.start == "uniform"
    prepare = as_built if random else None
    return train_network(with_drive(model, trajectories), trajectories, context, method, prepare)


def _parameters(rng: np.random.Generator, config: Config, context: Context) -> Params:
    hidden, gates = config.hidden, _GATES[config.cell]
    inputs = drive_size(config.features, context.nu)
    layers = [
        {
            "u": dense(rng, inputs if i == 0 else hidden, gates * hidden),
            "h": np.concatenate([_orthogonal(rng, hidden) for _ in range(gates)], axis=1),
            "b": _memory(rng, config),
        }
        for i in range(config.layers)
    ]
    states = (1 if config.tied else 2) * config.layers * hidden
    return {
        "enc_w1": dense(rng, window_size(context), config.encoder),
        "enc_b1": zeros(config.encoder),
        "enc_w2": dense(rng, config.encoder, states, gain=0.5),
        "enc_b2": zeros(states),
        "layers": layers,
        "out_w": zeros(hidden + (context.nu if config.direct else 0), context.ny),
        "out_b": zeros(context.ny),
    }


def _uniform_parameters(rng: np.random.Generator, config: Config, context: Context) -> Params:
    hidden, wide = config.hidden, _GATES[config.cell] * config.hidden
    inputs = drive_size(config.features, context.nu)
    layers = [
        {
            "u": uniform(rng, (inputs if i == 0 else hidden, wide), hidden),
            "h": uniform(rng, (hidden, wide), hidden),
            # PyTorch has a bias for each of the two products.
            "b": uniform(rng, (wide,), hidden) + uniform(rng, (wide,), hidden),
        }
        for i in range(config.layers)
    ]
    states = (1 if config.tied else 2) * config.layers * hidden
    seen, read = window_size(context), hidden + (context.nu if config.direct else 0)
    return {
        "enc_w1": uniform(rng, (seen, config.encoder), seen),
        "enc_b1": uniform(rng, (config.encoder,), seen),
        "enc_w2": uniform(rng, (config.encoder, states), config.encoder),
        "enc_b2": uniform(rng, (states,), config.encoder),
        "layers": layers,
        "out_w": uniform(rng, (read, context.ny), read),
        "out_b": uniform(rng, (context.ny,), read),
    }


def _orthogonal(rng: np.random.Generator, size: int) -> Float32:
    q, r = np.linalg.qr(rng.standard_normal((size, size)))
    return (0.9 * q * np.sign(np.diag(r))).astype(np.float32)


def _memory(rng: np.random.Generator, config: Config) -> Float32:
    """Biases; those of the gate that keeps the state spread the memory over 1 to 100 samples
    (chrono initialisation, Tallec and Ollivier, ICLR 2018)."""
    bias = np.zeros(_GATES[config.cell] * config.hidden, np.float32)
    if config.cell != "rnn":
        bias[config.hidden : 2 * config.hidden] = np.log(
            np.exp(rng.uniform(0.0, np.log(100.0), config.hidden)) + 1e-3
        )
    return bias
