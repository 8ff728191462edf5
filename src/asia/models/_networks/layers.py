"""Parts of networks that several families share: weights to start from, dense stacks, output layer,
normalisation, gated units, and linear systems in diagonal form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

# A pole nearer to the unit circle is rounded onto it.
_SLOWEST_RATE = 1e-6


def dense(rng: np.random.Generator, inputs: int, outputs: int, gain: float = 1.0) -> Float32:
    """Weights (inputs, outputs) with variance gain^2 / inputs (LeCun)."""
    scale = gain / np.sqrt(max(inputs, 1))
    return (scale * rng.standard_normal((inputs, outputs))).astype(np.float32)


def uniform(rng: np.random.Generator, shape: tuple[int, ...], fan_in: int) -> Float32:
    """Numbers within 1 / sqrt(fan_in) of zero."""
    bound = 1.0 / np.sqrt(max(fan_in, 1))
    return rng.uniform(-bound, bound, shape).astype(np.float32)


def zeros(*shape: int) -> Float32:
    """float32 zeros."""
    return np.zeros(shape, np.float32)


def linear_output(params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
    """Output layer out_w (hidden + nu, ny), out_b (ny,)."""
    return jnp.concatenate([features, u], axis=-1) @ params["out_w"] + params["out_b"]


def mlp_params(
    rng: np.random.Generator, sizes: Sequence[int], last_gain: float = 1.0
) -> list[dict[str, Float32]]:
    """Weights and biases of a stack of dense layers, sizes from input to output."""
    gains = [1.0] * (len(sizes) - 2) + [last_gain]
    return [
        {"w": dense(rng, a, b, gain), "b": zeros(b)}
        for a, b, gain in zip(sizes[:-1], sizes[1:], gains, strict=True)
    ]


def mlp(layers: Sequence[Mapping[str, Any]], x: jax.Array) -> jax.Array:
    """(..., sizes[0]) -> (..., sizes[-1]); tanh between layers, none after the last."""
    for layer in layers[:-1]:
        x = jnp.tanh(x @ layer["w"] + layer["b"])
    return x @ layers[-1]["w"] + layers[-1]["b"]


def normalised(x: jax.Array, gain: jax.Array) -> jax.Array:
    """Each sample scaled to unit root mean square over its channels, times gain (channels,).

    Source: Zhang and Sennrich, NeurIPS 2019 (RMSNorm).
    """
    return gain * x / jnp.sqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-6)


def gated(x: jax.Array, w: jax.Array, b: jax.Array) -> jax.Array:
    """Gated linear unit, w (channels, 2 * out): Dauphin et al., ICML 2017."""
    value, gate = jnp.split(x @ w + b, 2, axis=-1)
    return value * jax.nn.sigmoid(gate)


def decaying(start: jax.Array, log_tau: jax.Array, samples: int) -> jax.Array:
    """start (B, n) -> (B, samples, n): start * exp(-(k + 1) / tau), tau (n,) in samples."""
    time = jnp.arange(1, samples + 1, dtype=start.dtype)
    return start[:, None] * jnp.exp(-time[:, None] * jnp.exp(-log_tau))


def log_spaced(first: float, last: float, count: int) -> Float32:
    """Logarithms of `count` time constants spread from first to last."""
    return np.linspace(np.log(first), np.log(last), count).astype(np.float32)


def poles(log_rate: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """exp(-rate + i angle), inside the unit circle whatever the parameters, and the gain at which
    white noise of unit variance gives states of unit variance, however slow the pole."""
    rate = jnp.exp(log_rate) + _SLOWEST_RATE
    return jnp.exp(jax.lax.complex(-rate, angle)), jnp.sqrt(-jnp.expm1(-2 * rate))


def diagonal_states(pole: jax.Array, drive: jax.Array, start: jax.Array) -> jax.Array:
    """x[k] = pole x[k-1] + drive[k], x[-1] = start: pole (n,), drive (B, T, n), start (B, n), all
    complex -> (B, T, n)."""
    # An associative scan is no faster on a processor and takes eight times as long to compile.

    def step(x: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = pole * x + v
        return x, x

    return jnp.swapaxes(jax.lax.scan(step, start, jnp.swapaxes(drive, 0, 1))[1], 0, 1)
