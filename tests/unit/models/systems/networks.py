"""Structures with a handful of parameters, whose best values are known, and records for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models._networks.network import NetworkModel
from asia.models._networks.structure import Params

PAST = 2
A, B = 0.9, 0.4


@dataclass(frozen=True)
class Echo:
    """y[k] = a y[k-1] + b u[k] + c, fed with its own output and started from the measured one."""

    def parameters(self, context: Context) -> Params:
        rng = np.random.default_rng(context.seed)
        return start(*rng.uniform(0.1, 0.5, 2))

    def initial(self, params: Any, window: jax.Array) -> jax.Array:
        del params
        return window[:, -1:]

    def step(self, params: Any, state: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        y = params["a"] * state + params["b"] * u + params["c"]
        return y, y

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        del params, u
        return features

    def feed(self, params: Any, state: jax.Array, y: jax.Array, mask: jax.Array) -> jax.Array:
        del params
        return mask * y + (1 - mask) * state


@dataclass(frozen=True)
class Plain:
    """y = w u, all samples at once."""

    def sequence(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        del window
        return u * params["out_w"][0]


@dataclass(frozen=True)
class Hidden:
    """y = h w with h = (u, u, u, u), a feature map."""

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        del params, window
        return jnp.repeat(u, 4, axis=-1)

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        del u
        return features @ params["out_w"] + params["out_b"]


def start(a: float, b: float) -> dict[str, Any]:
    values = {"a": a, "b": b, "c": 0.0}
    return {name: np.full(1, value, np.float32) for name, value in values.items()}


def model(a: float = 0.2, b: float = 0.2) -> NetworkModel:
    return NetworkModel(Echo(), start(a, b))


def context(**changes: Any) -> Context:
    signals = (Signal("u"),), (Signal("y"),)
    return Context(*signals, 1.0, PAST, PAST, **{"seed": 5, **changes})


def records(*lengths: int, a: float = A, b: float = B, noise: float = 0.0) -> list[Trajectory]:
    """Responses of an Echo: what z-scores do to them an Echo can follow."""
    rng = np.random.default_rng(1)
    return [_record(rng, length, a, b, noise) for length in lengths]


def _record(rng: np.random.Generator, length: int, a: float, b: float, noise: float) -> Trajectory:
    u = rng.standard_normal((length, 1))
    y = np.zeros((length, 1))
    for k in range(1, length):
        y[k] = a * y[k - 1] + b * u[k]
    return Trajectory(u, y + noise * rng.standard_normal(y.shape), 1.0)


def error(fitted: NetworkModel, t: Trajectory) -> float:
    """Root mean squared simulation error over the output's standard deviation."""
    y: Array = fitted.simulate(t.u[None, :PAST], t.y[None, :PAST], t.u[None, PAST:])[0]
    return float(np.sqrt(((y - t.y[PAST:]) ** 2).mean()) / t.y.std())
