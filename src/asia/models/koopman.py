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
from functools import partial
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._arrays import AnyArray, namespace, scan, split
from asia.models._config import check_at_least
from asia.models._networks.network import Driven, NetworkModel, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    drive_size,
    log_spaced,
    mlp,
    mlp_params,
    zeros,
)
from asia.models._numerics.training_records import window_size

__all__ = ["Config", "NetworkModel", "build", "train"]

# A pole nearer to the unit circle is rounded onto it.
_SLOWEST_RATE = 1e-6
# Slowest of the log-spaced initial time constants, in samples.
_SLOWEST = 100.0
# Largest initial rotation of a state in one sample, in rad.
_LARGEST_ANGLE = 0.5


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
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "levels", "states", "lift", "width")
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
                    "log_rate": -log_spaced(1.0, _SLOWEST, c.states),
                    "angle": rng.uniform(0.0, _LARGEST_ANGLE, c.states).astype(np.float32),
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
            advanced = partial(_advanced, _pole(p))
            # An associative scan is no faster on a processor and takes eight times as long to
            # compile.
            drive = _driven(p, v, before).swapaxes(0, 1)
            found.append(scan(advanced, start, drive)[1].swapaxes(0, 1))
            before.append(xp.concatenate([start[:, None], found[-1][:, :-1]], axis=1))
        return xp.concatenate(found, axis=-1)

    def begin(self, params: Any, window: AnyArray) -> Any:
        """Latent state z of each level before the first sample, real parts and then imaginary
        ones."""
        return split(mlp(params["encoder"], window), self.config.levels)

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample."""
        u, xp = self.drive(u), namespace(u)
        v = xp.concatenate([u, mlp(params["lift"], u)], axis=-1)
        after = list[AnyArray]()
        for level, (p, z) in enumerate(zip(params["levels"], state, strict=True)):
            after.append(_advanced(_pole(p), z, _driven(p, v, state[:level]))[0])
        return after, xp.concatenate(after, axis=-1)


def _pole(p: Any) -> tuple[AnyArray, AnyArray]:
    """Factors of a level's state, and of its state with real and imaginary parts swapped, that
    multiply it by the poles exp(-rate + i angle), inside the unit circle whatever the
    parameters."""
    xp = namespace(p["log_rate"], p["angle"])
    radius = xp.exp(-xp.exp(p["log_rate"]) - _SLOWEST_RATE)
    a, b = radius * xp.cos(p["angle"]), radius * xp.sin(p["angle"])
    return xp.concatenate([a, a]), xp.concatenate([-b, b])


def _advanced(
    pole: tuple[AnyArray, AnyArray], z: AnyArray, drive: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Latent state of a level, real parts and then imaginary ones, after a sample with this drive,
    as `scan` requires."""
    same, swapped = pole
    half = z.shape[-1] // 2
    turned = namespace(z).concatenate([z[..., half:], z[..., :half]], axis=-1)
    z = same * z + swapped * turned + drive
    return z, z


def _driven(p: Any, v: AnyArray, before: list[AnyArray]) -> AnyArray:
    """Drive of a level, real parts and then imaginary ones, by inputs v (..., m) and by the lower
    levels of the sample before. White noise of unit variance gives states of unit variance, however
    slow the pole."""
    drive, xp = v @ p["b"], namespace(v, p["log_rate"])
    if before:
        lower = xp.concatenate(before, axis=-1)
        drive = drive + (lower @ p["left"]) * (v @ p["right"] + p["shift"])
    gain = xp.sqrt(-xp.expm1(-2 * (xp.exp(p["log_rate"]) + _SLOWEST_RATE)))
    return xp.concatenate([gain, gain]) * drive


build, train = network_family(Config, KoopmanMap)
