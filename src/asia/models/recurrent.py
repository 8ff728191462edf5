"""Recurrent networks: vanilla RNN, GRU, LSTM, in layers.

The state before the first sample comes from the past window through a small network; the output
is linear in the last layer's state and in the input. Sources: Cho et al., EMNLP 2014 (GRU);
Hochreiter and Schmidhuber, Neural Computation 9(8), 1997 (LSTM).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models._arrays import AnyArray, gates, namespace, relu, split
from asia.models._config import check_at_least, check_choice
from asia.models._networks.network import Driven, NetworkModel, Prepare, as_built, network_family
from asia.models._networks.structure import (
    Float32,
    Params,
    check_features,
    dense,
    drive_size,
    linear_output,
    uniform,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


_GATES = {"rnn": 1, "gru": 3, "lstm": 4}


@dataclass(frozen=True)
class Config:
    """Kind and size of the layers, and the weights that training starts from."""

    cell: Literal["rnn", "gru", "lstm"] = "gru"
    """Kind of the layers."""
    hidden: int = 32
    """Units of a layer."""
    layers: int = 1
    """Layers, each of which reads the one before."""
    encoder: int = 32
    """Units of the network that maps the past window to the initial state."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation of the inner layer of that network; with "relu" its outputs are linear, with
    "tanh" bounded."""
    tied: bool = False
    """Start the c of an LSTM equal to its h."""
    direct: bool = True
    """Give the output a linear term of the input of the same sample."""
    start: Literal["ridge", "uniform"] = "ridge"
    """"ridge" draws orthogonal recurrent weights and gates that remember 1 to 100 samples, and
    solves the output layer by ridge regression; "uniform" draws all weights within
    1 / sqrt(fan-in), as PyTorch does."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_choice(self, "cell", tuple(_GATES))
        check_at_least(1, self, "hidden", "layers", "encoder")
        check_choice(self, "activation", ("tanh", "relu"))
        check_choice(self, "start", ("ridge", "uniform"))
        check_features(self)


@dataclass(frozen=True)
class RecurrentCell(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.Cell`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        c, rng = self.config, np.random.default_rng(context.seed)
        hidden, parts = c.hidden, _GATES[c.cell]
        inputs, seen = drive_size(c.features, context.nu), window_size(context)
        states = (1 if c.tied else 2) * c.layers * hidden
        read = hidden + (context.nu if c.direct else 0)
        layers: list[dict[str, Float32]] = []
        for i in range(c.layers):
            wide = inputs if i == 0 else hidden, parts * hidden
            if c.start == "ridge":
                layers.append(
                    {
                        "u": dense(rng, *wide),
                        "h": np.concatenate([_orthogonal(rng, hidden) for _ in range(parts)], 1),
                        "b": _memory(rng, c),
                    }
                )
            else:
                layers.append(
                    {
                        "u": uniform(rng, wide, hidden),
                        "h": uniform(rng, (hidden, parts * hidden), hidden),
                        # PyTorch draws a bias for each of the two products.
                        "b": uniform(rng, wide[1:], hidden) + uniform(rng, wide[1:], hidden),
                    }
                )
        if c.start == "ridge":
            return {
                "enc_w1": dense(rng, seen, c.encoder),
                "enc_b1": zeros(c.encoder),
                "enc_w2": dense(rng, c.encoder, states, gain=0.5),
                "enc_b2": zeros(states),
                "layers": layers,
                "out_w": zeros(read, context.ny),
                "out_b": zeros(context.ny),
            }
        return {
            "enc_w1": uniform(rng, (seen, c.encoder), seen),
            "enc_b1": uniform(rng, (c.encoder,), seen),
            "enc_w2": uniform(rng, (c.encoder, states), c.encoder),
            "enc_b2": uniform(rng, (states,), c.encoder),
            "layers": layers,
            "out_w": uniform(rng, (read, context.ny), read),
            "out_b": uniform(rng, (context.ny,), read),
        }

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare | None:
        """Leave the weights of a "uniform" start as they are drawn."""
        del trajectories, context
        return as_built if self.config.start == "uniform" else None

    def initial(self, params: Any, window: AnyArray) -> Any:
        """State (h, c) of each layer; only the LSTM uses c."""
        tanh = namespace(window).tanh
        bend = tanh if self.config.activation == "tanh" else relu
        inner = bend(window @ params["enc_w1"] + params["enc_b1"])
        start = inner @ params["enc_w2"] + params["enc_b2"]
        if self.config.activation == "tanh":
            start = tanh(start)
        if self.config.tied:
            return [(h, h) for h in split(start, self.config.layers)]
        parts = split(start, 2 * self.config.layers)
        return [(parts[2 * i], parts[2 * i + 1]) for i in range(self.config.layers)]

    def step(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; each layer reads the one below."""
        signal, result = self.drive(u), []
        for layer, (h, c) in zip(params["layers"], state, strict=True):
            h, c = self._layer(layer, h, c, signal)
            result.append((h, c))
            signal = h
        return result, signal

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output, linear in the last layer's h and, with `direct`, in u."""
        if not self.config.direct:
            return features @ params["out_w"] + params["out_b"]
        return linear_output(params, features, u)

    def _layer(self, p: Any, h: AnyArray, c: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        drive, tanh = u @ p["u"] + p["b"], namespace(u).tanh
        if self.config.cell == "rnn":
            return tanh(drive + h @ p["h"]), c
        back = h @ p["h"]
        if self.config.cell == "gru":
            wide = 2 * h.shape[-1]
            reset, keep, _ = gates(drive + back, 3)
            new = tanh(drive[..., wide:] + reset * back[..., wide:])
            return new + keep * (h - new), c
        write, keep, read, new = gates(drive + back, 4)
        c = keep * c + write * tanh(new)
        return read * tanh(c), c


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


build, train = network_family(Config, RecurrentCell)
