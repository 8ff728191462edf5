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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Trajectory
from asia.errors import UserError
from asia.models._data.features import Driven, Features, check_features, drive_size, with_drive
from asia.models._networks.layers import diagonal_states, log_spaced, mlp, mlp_params, poles
from asia.models._networks.network import (
    NetworkModel,
    Params,
    dense,
    linear_output,
    train_network,
    window_size,
    zeros,
)
from asia.models.methods import NetworkMethod


@dataclass(frozen=True)
class Config:
    """levels; states: complex states a level; lift: channels that the inputs are lifted to beside
    themselves; width: units of the inner layers of both lifts; tau_max: slowest of the log-spaced
    initial time constants, in samples, the fastest being 1; angle_max: largest initial rotation a
    sample, in rad; features: functions of the inputs, see `asia.models._data.features`."""

    levels: int = 3
    states: int = 16
    lift: int = 8
    width: int = 32
    tau_max: float = 100.0
    angle_max: float = 0.5
    features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if min(self.levels, self.states, self.lift, self.width) < 1:
            raise UserError("koopman.Config: levels, states, lift and width must be at least 1")
        if self.tau_max < 1 or not 0 <= self.angle_max <= np.pi:
            raise UserError("koopman.Config: expected tau_max >= 1 and angle_max in [0, pi]")
        check_features(self.features, "koopman.Config")


@dataclass(frozen=True)
class KoopmanMap(Driven):
    """Structure of the model: see `asia.models._networks.network.FeatureMap`."""

    config: Config

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        rng, c = np.random.default_rng(context.seed), self.config
        nu, states = drive_size(c.features, context.nu), 2 * c.levels * c.states
        lifted = nu + c.lift
        return {
            "encoder": mlp_params(rng, (window_size(context), c.width, states)),
            "lift": mlp_params(rng, (nu, c.width, c.lift)),
            "levels": [_level_params(rng, c, lifted, 2 * i * c.states) for i in range(c.levels)],
            "out_w": zeros(states + context.nu, context.ny),
            "out_b": zeros(context.ny),
        }

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """z as real numbers: (B, T, 2 * levels * states)."""
        u = self.drive(u)
        v = jnp.concatenate([u, mlp(params["lift"], u)], axis=-1)
        starts = jnp.split(mlp(params["encoder"], window), self.config.levels, axis=-1)
        below = jnp.zeros((*v.shape[:2], 0), v.dtype)
        before = below
        for p, start in zip(params["levels"], starts, strict=True):
            z = _level(p, v, before, start)
            below = jnp.concatenate([below, z], axis=-1)
            previous = jnp.concatenate([start[:, None], z[:, :-1]], axis=1)
            before = jnp.concatenate([before, previous], axis=-1)
        return below

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """Linear in z and in u."""
        return linear_output(params, features, u)


def _level(p: Any, v: jax.Array, before: jax.Array, start: jax.Array) -> jax.Array:
    """v (B, T, m), before (B, T, lower states) of the sample before, start (B, 2 n) ->
    (B, T, 2 n): real parts, then imaginary parts."""
    pole, gain = poles(p["log_rate"], p["angle"])
    drive = v @ p["b"]
    if before.shape[-1]:
        drive = drive + (before @ p["left"]) * (v @ p["right"] + p["shift"])
    real, imaginary = jnp.split(drive, 2, axis=-1)
    z = diagonal_states(pole, jax.lax.complex(gain * real, gain * imaginary), _complex(start))
    return jnp.concatenate([jnp.real(z), jnp.imag(z)], axis=-1)


def _complex(x: jax.Array) -> jax.Array:
    real, imaginary = jnp.split(x, 2, axis=-1)
    return jax.lax.complex(real, imaginary)


def _level_params(rng: np.random.Generator, c: Config, lifted: int, lower: int) -> dict[str, Any]:
    return {
        "log_rate": -log_spaced(1.0, c.tau_max, c.states),
        "angle": rng.uniform(0.0, c.angle_max, c.states).astype(np.float32),
        "b": dense(rng, lifted, 2 * c.states),
        "left": dense(rng, lower, 2 * c.states),
        "right": dense(rng, lifted, 2 * c.states),
        "shift": zeros(2 * c.states),
    }


def build(config: Config, context: Context) -> NetworkModel:
    """An untrained model initialised from `context.seed`."""
    cell = KoopmanMap(config, drive=Features(config.features))
    return NetworkModel(cell, cell.parameters(context))


def train(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: NetworkMethod
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    return train_network(with_drive(model, trajectories), trajectories, context, method)
