"""Common parts of networks: initial weights, dense stacks, output layer, gates, linear systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.models._arrays import AnyArray, complex_number, namespace, scan, sigmoid, split

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
    """Zeros of float32."""
    return np.zeros(shape, np.float32)


def linear_output(params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
    """Output layer out_w (hidden + nu, ny), out_b (ny,)."""
    read = namespace(features, u).concatenate([features, u], axis=-1)
    return read @ params["out_w"] + params["out_b"]


def mlp_params(
    rng: np.random.Generator, sizes: Sequence[int], last_gain: float = 1.0
) -> list[dict[str, Float32]]:
    """Weights and biases of a stack of dense layers, sizes from input to output."""
    gains = [1.0] * (len(sizes) - 2) + [last_gain]
    return [
        {"w": dense(rng, a, b, gain), "b": zeros(b)}
        for a, b, gain in zip(sizes[:-1], sizes[1:], gains, strict=True)
    ]


def mlp(layers: Sequence[Mapping[str, Any]], x: AnyArray) -> AnyArray:
    """Apply dense layers (..., sizes[0]) -> (..., sizes[-1]); tanh between layers, none after
    the last."""
    xp = namespace(x)
    for layer in layers[:-1]:
        x = xp.tanh(x @ layer["w"] + layer["b"])
    return x @ layers[-1]["w"] + layers[-1]["b"]


def normalised(x: AnyArray, gain: AnyArray) -> AnyArray:
    """Scale each sample to unit root mean square over its channels, times gain (channels,).

    Source: Zhang and Sennrich, NeurIPS 2019 (RMSNorm).
    """
    return gain * x / namespace(x).sqrt((x * x).mean(axis=-1, keepdims=True) + 1e-6)


def gated(x: AnyArray, w: AnyArray, b: AnyArray) -> AnyArray:
    """Gated linear unit, w (channels, 2 * out): Dauphin et al., ICML 2017."""
    value, gate = split(x @ w + b, 2)
    return value * sigmoid(gate)


def decaying(start: AnyArray, log_tau: AnyArray, samples: int) -> AnyArray:
    """Decay start (B, n) -> (B, samples, n): start * exp(-(k + 1) / tau), tau (n,) in samples."""
    xp, time = namespace(start, log_tau), np.arange(1, samples + 1, dtype=start.dtype)
    return start[:, None] * xp.exp(-time[:, None] * xp.exp(-log_tau))


def log_spaced(first: float, last: float, count: int) -> Float32:
    """Logarithms of `count` time constants spread from first to last."""
    return np.linspace(np.log(first), np.log(last), count).astype(np.float32)


def poles(log_rate: AnyArray, angle: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Poles exp(-rate + i angle), and input gains for states of unit variance.

    The poles lie inside the unit circle whatever the parameters; white noise of unit variance gives
    states of unit variance, however slow the pole.
    """
    xp = namespace(log_rate, angle)
    rate = xp.exp(log_rate) + _SLOWEST_RATE
    return xp.exp(complex_number(-rate, angle)), xp.sqrt(-xp.expm1(-2 * rate))


def turned_pole(
    pole: AnyArray, real: AnyArray, imaginary: AnyArray, drive: tuple[AnyArray, AnyArray]
) -> tuple[AnyArray, AnyArray]:
    """Advance `diagonal_states` by one sample in real numbers: real and imaginary parts."""
    a, b = pole.real, pole.imag
    return a * real - b * imaginary + drive[0], a * imaginary + b * real + drive[1]


def diagonal_states(pole: AnyArray, drive: AnyArray, start: AnyArray) -> AnyArray:
    """Solve x[k] = pole x[k-1] + drive[k], x[-1] = start.

    Args:
        pole: (n,), complex.
        drive: (B, T, n), complex.
        start: (B, n), complex.

    Returns:
        (B, T, n).
    """
    # An associative scan is no faster on a processor and takes eight times as long to compile.

    def step(x: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        x = pole * x + v
        return x, x

    return scan(step, start, drive.swapaxes(0, 1))[1].swapaxes(0, 1)
