"""Liquid time-constant network in closed form.

h[k] = a h[k-1] + (1 - a) f(h[k-1], u[k]),  a = exp(-1 / tau), with a learned time constant tau
(in samples) for each state, f a two-layer tanh network, and an output linear in h and u.
Source: Hasani et al., Closed-form continuous-time neural networks, Nature Machine Intelligence 4,
2022.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.models._arrays import AnyArray, namespace
from asia.models._config import check_at_least, check_choice
from asia.models._networks.network import Driven, NetworkModel, Prepare, as_built, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    drive_size,
    log_spaced,
    uniform,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


@dataclass(frozen=True)
class Config:
    """Size of the network, and where its time constants and weights start."""

    hidden: int = 64
    """States, and units of the inner layers of f and of the network that gives the initial
    states."""
    tau_max: float = 25.0
    """Slowest of the log-spaced initial time constants, in samples; the fastest is 1."""
    start: Literal["ridge", "uniform"] = "ridge"
    """"ridge" solves the output layer by ridge regression before training; "uniform" draws all
    weights within 1 / sqrt(fan-in), as PyTorch does."""
    bounded: bool = True
    """End f and the network that gives the initial states in a tanh."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "hidden", "tau_max")
        check_choice(self, "start", ("ridge", "uniform"))
        check_features(self)


@dataclass(frozen=True)
class LTCCell(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.Cell`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        hidden, seen, nu = c.hidden, window_size(context), context.nu
        inputs = drive_size(c.features, nu)
        weights = {
            "enc_w1": (seen, hidden),
            "enc_w2": (hidden, hidden),
            "f_h": (hidden, hidden),
            "f_u": (inputs, hidden),
            "f_w2": (hidden, hidden),
        }
        biases = dict.fromkeys(("enc_b1", "enc_b2", "f_b1", "f_b2"), hidden)
        read = hidden + nu
        if c.start == "ridge":
            params = {name: dense(rng, *shape) for name, shape in weights.items()}
            params |= {name: zeros(size) for name, size in biases.items()}
            params |= {"out_w": zeros(read, context.ny), "out_b": zeros(context.ny)}
        else:
            shapes = weights | {name: (size,) for name, size in biases.items()}
            shapes |= {"out_w": (read, context.ny), "out_b": (context.ny,)}
            fan_in = {name: shape[0] for name, shape in weights.items()}
            # f's first layer reads h and u together.
            fan_in |= dict.fromkeys(("f_h", "f_u", "f_b1"), hidden + inputs)
            fan_in |= {
                "enc_b1": seen,
                "enc_b2": hidden,
                "f_b2": hidden,
                "out_w": read,
                "out_b": read,
            }
            params = {name: uniform(rng, shape, fan_in[name]) for name, shape in shapes.items()}
        return {**params, "log_tau": log_spaced(1.0, c.tau_max, hidden)}

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare | None:
        """Leave the weights of a "uniform" start as they are drawn."""
        del trajectories, context
        return as_built if self.config.start == "uniform" else None

    def initial(self, params: Any, window: AnyArray) -> AnyArray:
        """State h before the first sample."""
        inner = namespace(window).tanh(window @ params["enc_w1"] + params["enc_b1"])
        return self._bent(inner @ params["enc_w2"] + params["enc_b2"])

    def step(self, params: Any, state: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Advance by one sample: each state decays towards f with its own time constant."""
        xp = namespace(u)
        decay = xp.exp(-xp.exp(-params["log_tau"]))
        inner = xp.tanh(state @ params["f_h"] + self.drive(u) @ params["f_u"] + params["f_b1"])
        target = self._bent(inner @ params["f_w2"] + params["f_b2"])
        state = target + decay * (state - target)
        return state, state

    def _bent(self, values: AnyArray) -> AnyArray:
        return namespace(values).tanh(values) if self.config.bounded else values


build, train = network_family(Config, LTCCell)
