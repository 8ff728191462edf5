"""Structures of networks, and their simulation.

A family writes a structure, a frozen dataclass, as one of

- `Cell`: initial, step, output; the samples are scanned (RNN, LSTM, state space);
- `FeatureMap`: features, output; all samples at once (convolution, attention, parallel scan);
- `SequenceMap`: sequence; outputs at once, no output layer to start by regression.

and adds, where it has them, `feed` (`OutputFeedback`: teacher forcing) and `parameters`
(`Restartable`: fits from several seeds). `params["fixed"]` may hold a mapping of constants, such
as the scaling that an equation in physical units needs: no method changes them.

A structure is written once, for JAX arrays in training and NumPy arrays in simulation: it computes
by operators, by methods of arrays, and by what `asia.models._arrays` has for both. NumPy must stay
in float32: no NumPy number or array of float64 may meet the arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol, TypeAlias, runtime_checkable

from asia.candidate import Context
from asia.models._arrays import AnyArray, scan

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
        where mask (B, 1) is 1, and unchanged where it is 0."""
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
