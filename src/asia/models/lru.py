"""Linear recurrent units: stable linear systems in diagonal form between static networks.

Each layer is x[k] = pole x[k-1] + B v[k] with complex poles inside the unit circle whatever the
parameters, then a gated unit of Re(C x) + D v, added to what came in. A layer's states before the
first sample come from the past window. Source: Orvieto et al., Resurrecting recurrent neural
networks for long sequences, ICML 2023.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, complex_number, gelu, split
from asia.models._config import check_at_least, demand
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    diagonal_states,
    drive_size,
    gated,
    log_spaced,
    mlp,
    mlp_params,
    poles,
    rotated_pole,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


@dataclass(frozen=True)
class Config:
    """Number and size of the layers, and where their dynamics start."""

    layers: int = 2
    """Linear systems in series."""
    states: int = 16
    """Complex states of a layer."""
    width: int = 16
    """Channels between layers."""
    encoder: int = 32
    """Units of the network that maps the past window to the initial states."""
    tau_max: float = 100.0
    """Slowest of the log-spaced initial time constants, in samples; the fastest is 1."""
    angle_max: float = 0.5
    """Largest initial rotation of a state in one sample, in rad, at most pi."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "layers", "states", "width", "encoder")
        demand(self, "tau_max", self.tau_max >= 1, "at least 1 sample")
        demand(self, "angle_max", 0 <= self.angle_max <= np.pi, "an angle in [0, pi]")
        check_features(self)


@dataclass(frozen=True)
class LRUStack(Driven[Config]):
    """Structure of the network: see `asia.models._networks.structure.FeatureMap`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu, states = drive_size(c.features, context.nu), 2 * c.layers * c.states
        half = float(np.sqrt(0.5))
        return {
            "encoder": mlp_params(rng, (window_size(context), c.encoder, states)),
            "in": mlp_params(rng, (nu, c.width, c.width)),
            "layers": [
                {
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
                for _ in range(c.layers)
            ],
            "out_w": zeros(c.width + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Output of the last layer."""
        x = mlp(params["in"], self.drive(u))
        for p, start in zip(params["layers"], self.begin(params, window), strict=True):
            pole, gain = poles(p["log_rate"], p["angle"])
            drive = complex_number(gain * (x @ p["b_re"]), gain * (x @ p["b_im"]))
            states = diagonal_states(pole, drive, complex_number(*start))
            x = x + _read(p, x, states.real, states.imag)
        return x

    def begin(self, params: Any, window: AnyArray) -> Any:
        """Real and imaginary parts of each layer's states."""
        starts = split(mlp(params["encoder"], window), 2 * self.config.layers)
        return [(starts[2 * i], starts[2 * i + 1]) for i in range(self.config.layers)]

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, in real numbers."""
        x, after = mlp(params["in"], self.drive(u)), list[Any]()
        for p, (real, imaginary) in zip(params["layers"], state, strict=True):
            pole, gain = poles(p["log_rate"], p["angle"])
            drive = gain * (x @ p["b_re"]), gain * (x @ p["b_im"])
            real, imaginary = rotated_pole(pole, real, imaginary, drive)
            after.append((real, imaginary))
            x = x + _read(p, x, real, imaginary)
        return after, x


def _read(p: Any, v: AnyArray, real: AnyArray, imaginary: AnyArray) -> AnyArray:
    y = real @ p["c_re"] - imaginary @ p["c_im"] + v * p["d"]
    return gated(gelu(y), p["gate_w"], p["gate_b"])


build, train = network_family(Config, LRUStack)
