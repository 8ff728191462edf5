"""Liquid time-constant network in closed form.

h[k] = a h[k-1] + (1 - a) f(h[k-1], u[k]),  a = exp(-1 / tau), with a learned time constant tau
(in samples) for each state, f a two-layer tanh network, and an output linear in h and u.
Source: Hasani et al., Closed-form continuous-time neural networks, Nature Machine Intelligence 4,
2022.
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


@dataclass(frozen=True)
class Config:
    """hidden: states; width: units of the inner layer of f and of the initial-state network, None
    for as many as states; tau_min, tau_max: first and last of the log-spaced initial time
    constants, in samples; start: "ridge" solves the output layer by ridge regression, "uniform"
    draws all weights within 1 / sqrt(fan-in), as PyTorch does; bounded: whether f and the
    initial-state network end in a tanh or in their linear layer; features: functions of the inputs
    that f sees, see `asia.models._data.features`."""

    hidden: int = 64
    width: int | None = None
    tau_min: float = 1.0
    tau_max: float = 25.0
    start: Literal["ridge", "uniform"] = "ridge"
    bounded: bool = True
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.hidden < 1 or (self.width is not None and self.width < 1):
            raise UserError("ltc.Config: hidden and width must be at least 1")
        if not 0 < self.tau_min <= self.tau_max:
            raise UserError("ltc.Config: expected 0 < tau_min <= tau_max")
        if self.start not in ("ridge", "uniform"):
            raise UserError(f"ltc.Config: start is '{self.start}', expected ridge or uniform")
        check_features(self.features, "ltc.Config")


@dataclass(frozen=True)
class LTCCell(Driven):
    """Structure of the network: see `asia.models._networks.network.Cell`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        return _parameters(self.config, context)

    def initial(self, params: Any, window: jax.Array) -> jax.Array:
        """h before the first sample."""
        inner = jnp.tanh(window @ params["enc_w1"] + params["enc_b1"])
        return self._bent(inner @ params["enc_w2"] + params["enc_b2"])

    def step(self, params: Any, state: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Each state decays towards f with its own time constant."""
        decay = jnp.exp(-jnp.exp(-params["log_tau"]))
        inner = jnp.tanh(state @ params["f_h"] + self.drive(u) @ params["f_u"] + params["f_b1"])
        target = self._bent(inner @ params["f_w2"] + params["f_b2"])
        state = decay * state + (1 - decay) * target
        return state, state

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in h and u."""
        return linear_output(params, features, u)

    def _bent(self, values: jax.Array) -> jax.Array:
        return jnp.tanh(values) if self.config.bounded else values


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained network initialised from `context.seed`."""
    cell = LTCCell(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    random = isinstance(model.cell, LTCCell) and model.cell.config.start == "uniform"
    prepare = as_built if random else None
    return train_network(with_drive(model, trajectories), trajectories, context, method, prepare)


def _parameters(config: Config, context: Context) -> Params:
    rng = np.random.default_rng(context.seed)
    hidden, width = config.hidden, config.width or config.hidden
    seen, nu = window_size(context), context.nu
    inputs = drive_size(config.features, nu)
    shapes = {
        "enc_w1": (seen, width),
        "enc_w2": (width, hidden),
        "f_h": (hidden, width),
        "f_u": (inputs, width),
        "f_w2": (width, hidden),
    }
    taus = np.linspace(np.log(config.tau_min), np.log(config.tau_max), hidden)
    if config.start == "ridge":
        params = {name: dense(rng, *shape) for name, shape in shapes.items()}
        biases = {name: zeros(size) for name, size in _biases(config).items()}
        params |= biases | {"out_w": zeros(hidden + nu, context.ny), "out_b": zeros(context.ny)}
    else:
        # f's first layer reads h and u together.
        fan_in = {name: shape[0] for name, shape in shapes.items()}
        fan_in |= {"f_h": hidden + inputs, "f_u": hidden + inputs}
        fan_in |= {"enc_b1": seen, "enc_b2": width, "f_b1": hidden + inputs, "f_b2": width}
        shapes |= {name: (size,) for name, size in _biases(config).items()}
        shapes |= {"out_w": (hidden + nu, context.ny), "out_b": (context.ny,)}
        fan_in |= {"out_w": hidden + nu, "out_b": hidden + nu}
        params = {name: uniform(rng, shape, fan_in[name]) for name, shape in shapes.items()}
    return {**params, "log_tau": taus.astype(np.float32)}


def _biases(config: Config) -> dict[str, int]:
    width = config.width or config.hidden
    return {"enc_b1": width, "enc_b2": config.hidden, "f_b1": width, "f_b2": config.hidden}
