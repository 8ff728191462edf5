"""Simulation of a network compiled by JAX, which is imported with this module."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.models._arrays import AnyArray
from asia.models._networks.structure import (
    Cell,
    FeatureMap,
    NetworkStructure,
    Params,
    SequenceMap,
    Simulate,
    rollout,
)

# Samples of a block of a long simulation.
_BLOCK = 16_384


def compiled(
    simulate: Simulate, cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray
) -> AnyArray:
    """Simulate by JAX; the result is a NumPy array of the precision of u.

    Long simulations of a network with a state go block by block, by one program for all lengths.
    """
    with jax.enable_x64(u.dtype == np.float64):
        if u.shape[1] > _BLOCK and not isinstance(cell, FeatureMap | SequenceMap):
            return _by_blocks(cell, params, window, u, simulate is rollout)
        return np.asarray(_compiled(simulate, cell, params, window, u))


def _by_blocks(
    cell: Cell, params: Params, window: AnyArray, u: AnyArray, outputs: bool
) -> AnyArray:
    state, found = _initial(cell, params, window), None
    for first in range(0, u.shape[1], _BLOCK):
        part = u[:, first : first + _BLOCK]
        length = part.shape[1]
        if length < _BLOCK:
            part = np.pad(part, ((0, 0), (0, _BLOCK - length), (0, 0)))
        state, values = _advanced(cell, outputs, params, state, part)
        if found is None:
            found = np.empty((*u.shape[:2], values.shape[2]), values.dtype)
        found[:, first : first + length] = np.asarray(values)[:, :length]
    return found


@partial(jax.jit, static_argnums=(0, 1))
def _compiled(simulate: Simulate, cell: Any, params: Any, window: Any, u: Any) -> jax.Array:
    return simulate(cell, params, window, u)


@partial(jax.jit, static_argnums=0)
def _initial(cell: Any, params: Any, window: Any) -> Any:
    return cell.initial(params, window)


@partial(jax.jit, static_argnums=(0, 1))
def _advanced(cell: Any, outputs: bool, params: Any, state: Any, u: Any) -> tuple[Any, jax.Array]:
    step = partial(cell.step, params)
    state, features = jax.lax.scan(step, state, jnp.swapaxes(u, 0, 1))
    features = jnp.swapaxes(features, 0, 1)
    return state, cell.output(params, features, u) if outputs else features
