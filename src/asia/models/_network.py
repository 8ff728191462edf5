"""What recurrent families share: cells, simulation, a start for the output layer, the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from asia.candidate import Context
from asia.errors import UserError
from asia.models._records import (
    Batch,
    Record,
    batch,
    check,
    holdout_masks,
    reweighted,
    scaled,
    window,
)
from asia.models._scaling import Scaling
from asia.models.methods import Adam
from asia.problem import Array, Trajectory

Params = Mapping[str, Any]
Float32 = NDArray[np.float32]


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


def rollout(cell: Cell, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
    """window (B, d), u (B, T, nu) -> outputs (B, T, ny), all z-scored."""
    return cell.output(params, trace(cell, params, window, u), u)


def trace(cell: Cell, params: Any, window: jax.Array, u: jax.Array) -> jax.Array:
    """Features (B, T, hidden) that the outputs are read from."""
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
    """A recurrent network; `scaling` is None before training."""

    cell: Cell
    params: Params
    scaling: Scaling | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu), physical units ->
        (B, H, ny) float64. Raises UserError before training."""
        if self.scaling is None:
            raise UserError("network model: not trained yet; call train before simulate")
        past = window(self.scaling.inputs(past_u), self.scaling.outputs(past_y))
        inputs = self.scaling.inputs(u)
        with jax.enable_x64(False):
            y = _rollout(
                self.cell, self.params, np.asarray(past, np.float32), np.asarray(inputs, np.float32)
            )
            result = np.asarray(y, np.float64)
        return self.scaling.physical(result)


def train_network(
    model: NetworkModel, trajectories: Sequence[Trajectory], context: Context, method: Adam
) -> NetworkModel:
    """Fits to the simulation error; raises UserError for records too short or mis-shaped."""
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    with jax.enable_x64(False):
        params = with_output_layer(model, batch(records, context))
    params = train_cell(model.cell, params, records, context, method)
    return replace(model, params=params, scaling=scaling)


def train_cell(
    cell: Cell, params: Params, records: Sequence[Record], context: Context, method: Adam
) -> Params:
    """Trained float32 parameters, from z-scored records."""
    from asia.models._adam import train_adam

    fitted, held_out = batch(records, context), None
    if method.holdout > 0:
        masks = holdout_masks(records, method.holdout)
        fitted = batch(reweighted(records, masks, False), context)
        held_out = batch(reweighted(records, masks, True), context)
    with jax.enable_x64(False):
        seed = context.seed % 2**31
        return train_adam(cell, params, fitted, held_out, method, seed, context.log)


def with_output_layer(model: NetworkModel, data: Batch) -> Params:
    """The parameters with an output layer solved by ridge regression on the untrained states."""
    arrays = (np.asarray(data.window, np.float32), np.asarray(data.u, np.float32))
    hidden = np.asarray(_trace(model.cell, model.params, *arrays), np.float64)
    ones = np.ones((*data.u.shape[:2], 1))
    x = (np.concatenate([hidden, data.u, ones], axis=-1) * data.weight[..., None]).reshape(
        -1, hidden.shape[-1] + data.u.shape[-1] + 1
    )
    y = (data.y * data.weight[..., None]).reshape(len(x), -1)
    ridge = 0.01 * len(x) * np.eye(x.shape[1])
    ridge[-1, -1] = 1e-6
    solution = np.linalg.solve(x.T @ x + ridge, x.T @ y).astype(np.float32)
    return {**model.params, "out_w": solution[:-1], "out_b": solution[-1]}


def window_size(context: Context) -> int:
    """Length of the flattened past window."""
    return context.n_past_u * context.nu + context.n_past_y * context.ny


def dense(rng: np.random.Generator, inputs: int, outputs: int, gain: float = 1.0) -> Float32:
    """Weights (inputs, outputs) with variance gain^2 / inputs (LeCun)."""
    scale = gain / np.sqrt(max(inputs, 1))
    return (scale * rng.standard_normal((inputs, outputs))).astype(np.float32)


def zeros(*shape: int) -> Float32:
    """float32 zeros."""
    return np.zeros(shape, np.float32)
