"""Cascade of two liquid time-constant layers, one slow and one fast.

Each layer is h[k] = a h[k-1] + (1 - a) f(h[k-1], v[k]), a = exp(-1 / tau), as in `asia.models.ltc`;
the slow one is driven by the input, the fast one by the slow states and the input, and the output
is linear in both and in the input. A time constant is learned inside its layer's range, so that
the two time scales stay apart. Source: Hasani et al., Closed-form continuous-time neural networks,
Nature Machine Intelligence 4, 2022, for the layer.
"""

from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, namespace, sigmoid
from asia.models._config import check_at_least
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    drive_size,
    mlp,
    mlp_params,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]

# Least and greatest time constant of each layer, in samples.
_SLOW, _FAST = (10.0, 200.0), (0.5, 20.0)


@dataclass(frozen=True)
class Config:
    """Size of the two layers."""

    slow: int = 16
    """States of the slow layer."""
    fast: int = 16
    """States of the fast layer."""
    width: int = 32
    """Units of the inner layer of each f and of the network that gives the initial states."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "slow", "fast", "width")
        check_features(self)


@dataclass(frozen=True)
class CascadedLTCCell(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.Cell`."""

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

    def initial(self, params: Any, window: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Slow and fast states before the first sample."""
        start = namespace(window).tanh(mlp(params["encoder"], window))
        return start[:, : self.config.slow], start[:, self.config.slow :]

    def step(
        self, params: Any, state: tuple[AnyArray, AnyArray], u: AnyArray
    ) -> tuple[tuple[AnyArray, AnyArray], AnyArray]:
        """Advance by one sample; the fast layer reads the slow states of the same sample."""
        u, xp = self.drive(u), namespace(u)
        slow = _layer(params["slow"], *_SLOW, state[0], u)
        drive = xp.concatenate([slow, u], axis=-1)
        fast = _layer(params["fast"], *_FAST, state[1], drive)
        return (slow, fast), xp.concatenate([slow, fast], axis=-1)


def _layer(p: Any, low: float, high: float, h: AnyArray, drive: AnyArray) -> AnyArray:
    xp = namespace(drive)
    decay = xp.exp(-1.0 / time_constants(p["place"], low, high))
    inner = xp.tanh(h @ p["h"] + drive @ p["drive"] + p["b1"])
    target = xp.tanh(inner @ p["w2"] + p["b2"])
    return target + decay * (h - target)


def time_constants(place: AnyArray, low: float, high: float) -> AnyArray:
    """Time constants in samples, between low and high on a log scale, for parameters of any
    size."""
    return namespace(place).exp(log(low) + sigmoid(place) * log(high / low))


def _layer_params(rng: np.random.Generator, inputs: int, states: int, width: int) -> dict[str, Any]:
    return {
        "h": dense(rng, states, width),
        "drive": dense(rng, inputs, width),
        "b1": zeros(width),
        "w2": dense(rng, width, states),
        "b2": zeros(states),
        "place": np.linspace(-2.5, 2.5, states).astype(np.float32),
    }


build, train = network_family(Config, CascadedLTCCell)
