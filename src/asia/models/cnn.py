"""Temporal convolutional network: dilated causal convolutions over the inputs.

Blocks of gated convolutions with dilations 1, 2, 4, ... see `receptive_field` samples back. The
information of the past window enters as channels that start from a learned function of it and
decay, each with its own learned time constant, so that the model reaches further back than its
convolutions there. Sources: Bai, Kolter and Koltun, arXiv 1803.01271, 2018; Andersson et al., Deep
convolutional networks in system identification, CDC 2019; van den Oord et al., arXiv 1609.03499,
2016 (gates).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, namespace, sigmoid, split
from asia.models._config import check_at_least
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    decaying,
    dense,
    drive_size,
    log_spaced,
    mlp,
    mlp_params,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]

# Taps of a convolution.
_TAPS = 3


@dataclass(frozen=True)
class Config:
    """Reach and size of the convolutions, and size of the memory of the past window."""

    receptive_field: int = 128
    """Samples of input that an output depends on, at least."""
    width: int = 16
    """Channels of a block."""
    memory: int = 16
    """Channels that carry the past window; their initial time constants are log-spaced from 1 to
    the receptive field."""
    encoder: int = 32
    """Units of the network that fills them."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "width", "memory", "encoder")
        check_at_least(2, self, "receptive_field")
        check_features(self)

    @property
    def dilations(self) -> tuple[int, ...]:
        """Dilations 1, 2, 4, ...: as many as the receptive field needs."""
        found = [1]
        while 1 + (_TAPS - 1) * sum(found) < self.receptive_field:
            found.append(2 * found[-1])
        return tuple(found)


@dataclass(frozen=True)
class ConvolutionStack(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.FeatureMap`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        inputs = drive_size(c.features, context.nu) + c.memory
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, c.memory)),
            "log_tau": log_spaced(1.0, c.receptive_field, c.memory),
            "in": mlp_params(rng, (inputs, c.width)),
            "blocks": [
                {
                    "taps": dense(rng, _TAPS * c.width, 2 * c.width),
                    "b1": zeros(2 * c.width),
                    "w2": dense(rng, c.width, c.width),
                    "b2": zeros(c.width),
                }
                for _ in c.dilations
            ],
            "out_w": zeros(c.width + c.memory + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Last block's channels and the memory of the past window."""
        xp = namespace(u)
        memory = decaying(mlp(params["encoder"], window), params["log_tau"], u.shape[1])
        x = mlp(params["in"], xp.concatenate([self.drive(u), memory], axis=-1))
        for p, dilation in zip(params["blocks"], self.config.dilations, strict=True):
            delays = [dilation * i for i in range(_TAPS)]
            x = _block(p, x, [xp.pad(x, ((0, 0), (d, 0), (0, 0)))[:, : x.shape[1]] for d in delays])
        return xp.concatenate([x, memory], axis=-1)

    def begin(self, params: Any, window: AnyArray) -> Any:
        """Memory before the first sample, and the past inputs that the taps of each block read."""
        xp, c = namespace(window), self.config
        rows = [(_TAPS - 1) * dilation for dilation in c.dilations]
        taps = [xp.zeros((len(window), n, c.width), window.dtype) for n in rows]
        return mlp(params["encoder"], window), taps

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; the past inputs of a block are in a line that moves on."""
        xp, (memory, lines) = namespace(u), state
        memory = memory * xp.exp(-xp.exp(-params["log_tau"]))
        x = mlp(params["in"], xp.concatenate([self.drive(u), memory], axis=-1))
        after: list[AnyArray] = []
        for p, dilation, line in zip(params["blocks"], self.config.dilations, lines, strict=True):
            known = xp.concatenate([line, x[:, None]], axis=1)
            last = known.shape[1] - 1
            taps = [known[:, last - dilation * i] for i in range(_TAPS)]
            x = _block(p, x, taps)
            after.append(known[:, 1:])
        return (memory, after), xp.concatenate([x, memory], axis=-1)


def _block(p: Any, x: AnyArray, taps: list[AnyArray]) -> AnyArray:
    xp = namespace(x)
    value, gate = split(xp.concatenate(taps, -1) @ p["taps"] + p["b1"], 2)
    return x + (xp.tanh(value) * sigmoid(gate)) @ p["w2"] + p["b2"]


build, train = network_family(Config, ConvolutionStack)
