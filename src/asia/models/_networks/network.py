"""What network families share: structures, simulation, a start for the output layer, the model.

A family writes a structure, a frozen dataclass, as one of

- `Cell`: initial, step, output; the samples are scanned (RNN, LSTM, state space);
- `FeatureMap`: features, output; all samples at once (convolution, attention, parallel scan);
- `SequenceMap`: sequence; outputs at once, no output layer to start by regression.

and adds, where it has them, `feed` (`OutputFeedback`: teacher forcing) and `parameters`
(`Restartable`: fits from several seeds). `params["fixed"]` may hold a mapping of constants, such
as the scaling that an equation in physical units needs: no method changes them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context, Model
from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._data.records import ScaledData, batch, check, scaled, window
from asia.models._data.scaling import Scaling
from asia.models.methods import NetworkMethod

Params = Mapping[str, Any]
Float32 = NDArray[np.float32]
Prepare = Callable[[Params, ScaledData, Scaling], Params]
"""Parameters to start training from, given z-scored records: for example a linear fit."""


@runtime_checkable
class Cell(Protocol):
    """Structure of a recurrent network, hashable; parameters live apart in a mapping.

    Shapes: window (B, d), u (B, nu), a state is any tree of arrays (B, ...).
    """

    def initial(self, params: Any, window: jax.Array) -> Any:
        """State before the first sample."""
        ...

    def step(self, params: Any, state: Any, u: jax.Array) -> tuple[Any, jax.Array]:
        """Next state, and what the output of this sample is read from, (B, hidden)."""
        ...

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """features (..., hidden), u (..., nu) -> outputs (..., ny)."""
        ...


@runtime_checkable
class FeatureMap(Protocol):
    """A structure that computes the features of all samples at once, causally."""

    def features(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """window (B, d), u (B, T, nu) -> (B, T, hidden)."""
        ...

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """features (..., hidden), u (..., nu) -> outputs (..., ny)."""
        ...


@runtime_checkable
class SequenceMap(Protocol):
    """A structure that computes the outputs of all samples at once, causally; it is used in place
    of stepping where a structure has both."""

    def sequence(self, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
        """window (B, d), u (B, T, nu) -> outputs (B, T, ny)."""
        ...


NetworkStructure: TypeAlias = Cell | FeatureMap | SequenceMap


@runtime_checkable
class OutputFeedback(Protocol):
    """A cell whose state holds its own last output, which training may replace by the measured."""

    def feed(self, params: Any, state: Any, y: jax.Array, mask: jax.Array) -> Any:
        """State after a step with its output replaced by y (B, ny), z-scored, of the same sample
        where mask (B, 1) is 1, and unchanged where it is 0."""
        ...


@runtime_checkable
class Restartable(Protocol):
    """A structure that can draw its untrained parameters again."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`."""
        ...


def rollout(cell: NetworkStructure, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
    """window (B, d), u (B, T, nu) -> outputs (B, T, ny), all z-scored."""
    if isinstance(cell, SequenceMap):
        return cell.sequence(params, window, u)
    return cell.output(params, trace(cell, params, window, u), u)


def trace(cell: Cell | FeatureMap, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
    """Features (B, T, hidden) that the outputs are read from."""
    if isinstance(cell, FeatureMap):
        return cell.features(params, window, u)
    inputs = jnp.swapaxes(u, 0, 1)
    start = cell.initial(params, window)
    _, features = jax.lax.scan(lambda state, u: cell.step(params, state, u), start, inputs)
    return jnp.swapaxes(features, 0, 1)


def linear_output(params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
    """Output layer out_w (hidden + nu, ny), out_b (ny,)."""
    return jnp.concatenate([features, u], axis=-1) @ params["out_w"] + params["out_b"]


_rollout = partial(jax.jit, static_argnums=0)(rollout)
_trace = partial(jax.jit, static_argnums=0)(trace)


@dataclass(frozen=True)
class NetworkModel:
    """A network; `scaling` is None before training. `others` are the parameters of further
    members, whose simulations are averaged with that of `params`."""

    cell: NetworkStructure
    params: Params
    scaling: Scaling | None = None
    others: tuple[Params, ...] = ()

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu), physical units ->
        (B, H, ny) float64. Raises UserError before training."""
        if self.scaling is None:
            raise UserError("network model: not trained yet; call train before simulate")
        past = window(self.scaling.inputs(past_u), self.scaling.outputs(past_y))
        inputs = self.scaling.inputs(u)
        arrays = np.asarray(past, np.float32), np.asarray(inputs, np.float32)
        members = (self.params, *self.others)
        with jax.enable_x64(False):
            outputs = [np.asarray(_rollout(self.cell, p, *arrays), np.float64) for p in members]
        return self.scaling.physical(sum(outputs[1:], outputs[0]) / len(outputs))


def train_network(
    model: NetworkModel,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: NetworkMethod,
    prepare: Prepare | None = None,
) -> NetworkModel:
    """Fits to the simulation error.

    `prepare` gives the parameters to start from; None solves the output layer `out_w`, `out_b` by
    ridge regression where the structure reads it as `linear_output` does. Raises UserError for
    records too short or mis-shaped, and for a method that does not go with the structure.
    """
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    cell = model.cell
    if method.members > 1 and not isinstance(cell, Restartable):
        raise UserError(
            f"{type(method).__name__}: members is {method.members}, but this family starts from "
            "its data and not from a seed; leave members at 1"
        )
    members: list[Params] = []
    for i in range(method.members):
        params, own = model.params, replace(context, seed=context.seed + i)
        if i > 0 and isinstance(cell, Restartable):
            params = cell.parameters(own)
        if prepare is None:
            params = with_output_layer(cell, params, records, context)
        else:
            params = prepare(params, records, scaling)
        members.append(
            train_cell(
                cell, params, records, own, method,
                lambda p: NetworkModel(cell, p, scaling),
            )
        )  # fmt: skip
    return replace(model, params=members[0], scaling=scaling, others=tuple(members[1:]))


def as_built(params: Params, records: ScaledData, scaling: Scaling) -> Params:
    """A `Prepare` that changes nothing: for families that start from random weights."""
    del records, scaling
    return params


def train_cell(
    cell: NetworkStructure,
    params: Params,
    records: ScaledData,
    context: Context,
    method: NetworkMethod,
    model_of: Callable[[Params], Model] | None = None,
) -> Params:
    """Trained float32 parameters of one network, from z-scored records. `model_of` makes the model
    that is asked about in early stopping on the validation score; without it there is none."""
    from asia.models._networks.training import fit

    return fit(cell, params, records, context, method, model_of)


def with_output_layer(
    cell: NetworkStructure, params: Params, records: ScaledData, context: Context
) -> Params:
    """The parameters with an output layer solved by ridge regression on the untrained states, as
    they are where there is no such layer."""
    from asia.models._data.chunks import laid, whole

    if "out_w" not in params or (isinstance(cell, SequenceMap) and not isinstance(cell, Cell)):
        return params
    samples = batch(records, context)
    with jax.enable_x64(False):
        data = whole(samples) if context.horizon is None else laid(samples, context.horizon)
        traced = _trace(cell, params, data.window, data.u)
        x, u, y, weight = (np.asarray(v, np.float64) for v in (traced, *data[1:]))
    rows = len(params["out_w"])
    if rows == x.shape[-1] + u.shape[-1]:
        x = np.concatenate([x, u], axis=-1)
    elif rows != x.shape[-1]:
        return params
    if not np.isfinite(x).all():
        return params
    x = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=-1)[weight > 0]
    ridge = 0.01 * len(x) * np.eye(rows + 1)
    ridge[-1, -1] = 1e-6
    solution = np.linalg.solve(x.T @ x + ridge, x.T @ y[weight > 0]).astype(np.float32)
    return {**params, "out_w": solution[:-1], "out_b": solution[-1]}


def window_size(context: Context) -> int:
    """Length of the flattened past window."""
    return context.n_past_u * context.nu + context.n_past_y * context.ny


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
