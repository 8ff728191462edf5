"""Structures of networks: layers and input features."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeAlias, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace, scan
from asia.models._config import owner
from asia.models._numerics.scaling import Scaling

# Structures of networks, and their simulation.
#
# A family writes a structure, a frozen dataclass, as one of
#
# - `Cell`: initial, step, output; the samples are scanned (RNN, LSTM, state space); -
# `FeatureMap`: features, output; all samples at once (convolution, attention, parallel scan); -
# `SequenceMap`: sequence; outputs at once, no output layer to start by regression.
#
# and adds, where it has them, `feed` (`OutputFeedback`: teacher forcing) and `parameters`
# (`Restartable`: fits from several seeds). `params["fixed"]` may hold a mapping of constants, such
# as the scaling that an equation in physical units needs: no method changes them.
#
# A structure is written once, for JAX arrays in training and NumPy arrays in simulation: it
# computes by operators, by methods of arrays, and by what `asia.models._arrays` has for both.
# NumPy must stay in float32: no NumPy number or array of float64 may meet the arrays.

Params = Mapping[str, Any]
"""Arrays by name: weights, and trees of weights of inner layers."""


@runtime_checkable
class Cell(Protocol):
    """Structure of a recurrent network, hashable; parameters live apart in a mapping.

    Shapes: window (B, d), u (B, nu), a state is any tree of arrays (B, ...).
    """

    def initial(self, params: Any, window: AnyArray) -> Any:
        """State before the first sample."""
        ...

    def step(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Next state, and the features (B, hidden) from which the output of this sample is read."""
        ...

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Outputs (..., ny) from features (..., hidden) and u (..., nu)."""
        ...


@runtime_checkable
class FeatureMap(Protocol):
    """Structure that computes the features of all samples at once, causally."""

    def features(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Features (B, T, hidden) from window (B, d) and u (B, T, nu)."""
        ...

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Outputs (..., ny) from features (..., hidden) and u (..., nu)."""
        ...


@runtime_checkable
class OneSample(Protocol):
    """Interface of a `FeatureMap` that can also go sample by sample, for use in a loop."""

    def begin(self, params: Any, window: AnyArray) -> Any:
        """State before the first sample, any tree of arrays, from window (B, d)."""
        ...

    def advance(self, params: Any, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """State after a sample u (B, nu), and its features (B, hidden)."""
        ...

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Outputs (..., ny) from features (..., hidden) and u (..., nu)."""
        ...


@runtime_checkable
class SequenceMap(Protocol):
    """Structure that computes the outputs of all samples at once, causally; it is used in place
    of stepping where a structure has both."""

    def sequence(self, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Outputs (B, T, ny) from window (B, d) and u (B, T, nu)."""
        ...


NetworkStructure: TypeAlias = Cell | FeatureMap | SequenceMap


class Simulate(Protocol):
    """Type of `rollout` and `trace`."""

    def __call__(self, cell: Any, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
        """Simulate: window (B, d), u (B, T, nu) -> (B, T, channels)."""
        ...


@runtime_checkable
class OutputFeedback(Protocol):
    """Cell whose state holds its own last output, which training may replace by the measured
    one."""

    def feed(self, params: Any, state: Any, y: AnyArray, mask: AnyArray) -> Any:
        """State after a step with its output replaced by y (B, ny), z-scored, of the same sample
        where mask (B, ny) is 1, and unchanged where it is 0."""
        ...


@runtime_checkable
class Augmented(Cell, Protocol):
    """Cell for which training draws one of several equivalent ways to see each simulation."""

    def drawn(self, params: Any, state: Any, key: AnyArray) -> Any:
        """The state before the first sample, with a way drawn for each row."""
        ...


@runtime_checkable
class Penalised(Protocol):
    """Structure with a penalty on some parameters in addition to the loss."""

    def penalty(self, params: Any) -> AnyArray:
        """Penalty that is added to the loss of a step."""
        ...


@runtime_checkable
class Restartable(Protocol):
    """Structure that can draw its untrained parameters again."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        ...


def rollout(cell: NetworkStructure, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
    """Outputs (B, T, ny) from window (B, d) and u (B, T, nu), all z-scored."""
    if isinstance(cell, SequenceMap):
        return cell.sequence(params, window, u)
    return cell.output(params, trace(cell, params, window, u), u)


def trace(cell: Cell | FeatureMap, params: Any, window: AnyArray, u: AnyArray) -> AnyArray:
    """Features (B, T, hidden) that the outputs are read from."""
    if isinstance(cell, FeatureMap):
        return cell.features(params, window, u)
    start = cell.initial(params, window)
    step = partial(cell.step, params)
    return scan(step, start, u.swapaxes(0, 1))[1].swapaxes(0, 1)


# Common parts of networks: initial weights, dense stacks, output layer.

Float32 = NDArray[np.float32]


def cast_tree(tree: Any, dtype: type[np.floating[Any]]) -> Any:
    """Convert all arrays of a tree of mappings and sequences to NumPy arrays of one type."""
    if isinstance(tree, Mapping):
        branches = cast("Mapping[str, Any]", tree)
        return {name: cast_tree(branch, dtype) for name, branch in branches.items()}
    if isinstance(tree, list | tuple):
        return [cast_tree(branch, dtype) for branch in cast("Sequence[Any]", tree)]
    return np.asarray(tree, dtype)


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


def decaying(start: AnyArray, log_tau: AnyArray, samples: int) -> AnyArray:
    """Decay start (B, n) -> (B, samples, n): start * exp(-(k + 1) / tau), tau (n,) in samples."""
    xp, time = namespace(start, log_tau), np.arange(1, samples + 1, dtype=start.dtype)
    return start[:, None] * xp.exp(-time[:, None] * xp.exp(-log_tau))


def log_spaced(first: float, last: float, count: int) -> Float32:
    """Logarithms of `count` time constants spread from first to last."""
    return np.linspace(np.log(first), np.log(last), count).astype(np.float32)


# Elementwise functions of the physical inputs, offered to a network in addition to the inputs.
#
# A thrust goes with the square of a motor speed: a network that is given the square need not learn
# it. The functions act on the input in physical units, because a z-score has lost its zero.


class NetworkConfig(Protocol):
    """Settings of a family whose network reads functions of the inputs."""

    @property
    def features(self) -> tuple[str, ...]:
        """Names of these functions."""
        ...


FUNCTIONS: dict[str, Callable[[AnyArray], AnyArray]] = {
    "square": lambda u: u * u,
    "cube": lambda u: u * u * u,
    "abs": abs,
    # The slope of the square root has no bound at zero, where an input often rests.
    "sqrt": lambda u: u / namespace(u).sqrt(abs(u) + 1e-3),
}


def check_features(settings: NetworkConfig) -> None:
    """Check that `settings.features` names known functions. Raises UserError if it does not."""
    for name in settings.features:
        if name not in FUNCTIONS:
            known = ", ".join(FUNCTIONS)
            raise UserError(
                f"{owner(settings)}: feature '{name}' is unknown, expected some of {known}"
            )


def drive_size(names: Sequence[str], nu: int) -> int:
    """Number of channels that drive a cell with these features."""
    return nu * (1 + len(names))


@dataclass(frozen=True)
class Features:
    """Map from z-scored inputs to those inputs and standardised functions of the physical ones.

    Each physical input is in units of its own root mean square. Hashable, so that a structure may
    hold it; before `fitted` only one without functions can be called.
    """

    names: tuple[str, ...] = ()  # Functions, of `FUNCTIONS`
    offset: tuple[float, ...] = ()  # Mean of each input in units of its root mean square
    gain: tuple[float, ...] = ()
    """Standard deviation of each input in units of its root mean square."""
    centre: tuple[float, ...] = ()  # Mean over the training data of each function of each input
    spread: tuple[float, ...] = ()
    """Standard deviation over the training data of each function of each input."""

    def fitted(self, trajectories: Sequence[Trajectory]) -> Features:
        """Standardise the functions on these records."""
        if not self.names:
            return self
        scaling = Scaling.of(trajectories)
        u = np.concatenate([t.u for t in trajectories])
        size = np.sqrt((u**2).mean(axis=0))
        size = np.where(size > 0, size, 1.0)
        raw = _applied(self.names, u / size)
        spread = raw.std(axis=0)
        spread = np.where(spread > 1e-6, spread, 1.0)
        numbers = scaling.u_mean / size, scaling.u_std / size, raw.mean(axis=0), spread
        return Features(self.names, *(tuple(map(float, values)) for values in numbers))

    def __call__(self, u: AnyArray) -> AnyArray:
        """Map (..., nu) z-scores -> (..., nu * (1 + functions))."""
        if not self.names:
            return u
        numbers = (self.gain, self.offset, self.centre, self.spread)
        gain, offset, centre, spread = (np.asarray(v, u.dtype) for v in numbers)
        extra = (_applied(self.names, u * gain + offset) - centre) / spread
        return namespace(u).concatenate([u, extra], axis=-1)


def _applied(names: Sequence[str], u: AnyArray) -> AnyArray:
    return namespace(u).concatenate([FUNCTIONS[name](u) for name in names], axis=-1)
