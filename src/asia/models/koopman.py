"""Koopman model with control: a latent state that is linear in itself, read linearly.

z[k] = A z[k-1] + B v[k] + sum_i v_i[k] N_i z[k-1],  y = C z + D u + offset, where v is a learned
lift of the inputs and z before the first sample a learned lift of the past window. A is diagonal
with poles inside the unit circle. The states stand in levels and the bilinear terms N_i lead only
from lower levels to higher ones, which keeps the model stable for every bounded input and is the
form that a truncated Carleman linearisation takes; one level is the model without bilinear terms.
Trained by the simulation error. Sources: Korda and Mezic, Automatica 93, 2018 (lift with control);
Goswami and Paley, CDC 2017 (bilinear terms); Lusch et al., Nature Communications 9, 2018 (learned
lift).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, complex_number, namespace, split
from asia.models._config import check_at_least, demand
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    diagonal_states,
    drive_size,
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
    """Size of the latent state and of the lifts, and where its dynamics start."""

    levels: int = 3
    """Levels of the latent state; 1 is the model without bilinear terms."""
    states: int = 16
    """Complex states of a level."""
    lift: int = 8
    """Channels that the inputs are lifted to, beside the inputs themselves."""
    width: int = 32
    """Units of the inner layer of both lifts."""
    tau_max: float = 100.0
    """Slowest of the log-spaced initial time constants, in samples; the fastest is 1."""
    angle_max: float = 0.5
    """Largest initial rotation of a state in one sample, in rad, at most pi."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "levels", "states", "lift", "width")
        demand(self, "tau_max", self.tau_max >= 1, "at least 1 sample")
        demand(self, "angle_max", 0 <= self.angle_max <= np.pi, "an angle in [0, pi]")
        check_features(self)


@dataclass(frozen=True)
class KoopmanMap(Driven[Config]):
    """Structure of the model: see `asia.models._networks.structure.FeatureMap`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu, states = drive_size(c.features, context.nu), 2 * c.levels * c.states
        lifted = nu + c.lift
        return {
            "encoder": mlp_params(rng, (window_size(context), c.width, states)),
            "lift": mlp_params(rng, (nu, c.width, c.lift)),
            "levels": [
                {
                    "log_rate": -log_spaced(1.0, c.tau_max, c.states),
                    "angle": rng.uniform(0.0, c.angle_max, c.states).astype(np.float32),
                    "b": dense(rng, lifted, 2 * c.states),
                    "left": dense(rng, 2 * level * c.states, 2 * c.states),
                    "right": dense(rng, lifted, 2 * c.states),
                    "shift": zeros(2 * c.states),
                }
                for level in range(c.levels)
            ],
            "out_w": zeros(states + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Latent state z as real numbers: (B, T, 2 * levels * states)."""
        u, xp = self.drive(u), namespace(u)
        v = xp.concatenate([u, mlp(params["lift"], u)], axis=-1)
        starts = split(mlp(params["encoder"], window), self.config.levels)
        found: list[AnyArray] = []
        before: list[AnyArray] = []
        for p, start in zip(params["levels"], starts, strict=True):
            pole, gain = poles(p["log_rate"], p["angle"])
            real, imaginary = _driven(p, v, before)
            first = complex_number(*split(start, 2))
            z = diagonal_states(pole, complex_number(gain * real, gain * imaginary), first)
            found.append(xp.concatenate([z.real, z.imag], axis=-1))
            before.append(xp.concatenate([start[:, None], found[-1][:, :-1]], axis=1))
        return xp.concatenate(found, axis=-1)

    def begin(self, params: Any, window: AnyArray) -> Any:
        """Latent state z of each level before the first sample, real parts and then imaginary
        ones."""
        return split(mlp(params["encoder"], window), self.config.levels)

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, in real numbers."""
        u, xp = self.drive(u), namespace(u)
        v = xp.concatenate([u, mlp(params["lift"], u)], axis=-1)
        after = list[AnyArray]()
        for level, (p, z) in enumerate(zip(params["levels"], state, strict=True)):
            pole, gain = poles(p["log_rate"], p["angle"])
            real, imaginary = _driven(p, v, state[:level])
            z_real, z_imaginary = split(z, 2)
            moved = rotated_pole(pole, z_real, z_imaginary, (gain * real, gain * imaginary))
            after.append(xp.concatenate(moved, axis=-1))
        return after, xp.concatenate(after, axis=-1)


def _driven(p: Any, v: AnyArray, before: list[AnyArray]) -> list[AnyArray]:
    """Real and imaginary parts of the drive of a level by inputs v (..., m) and by the lower levels
    of the sample before."""
    drive = v @ p["b"]
    if before:
        lower = namespace(v).concatenate(before, axis=-1)
        drive = drive + (lower @ p["left"]) * (v @ p["right"] + p["shift"])
    return split(drive, 2)


build, train = network_family(Config, KoopmanMap)
