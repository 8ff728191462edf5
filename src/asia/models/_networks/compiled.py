"""Simulation of a network compiled by JAX, which is imported with this module."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np

from asia.models._arrays import AnyArray
from asia.models._networks.structure import NetworkStructure, Params, Simulate


def compiled(
    simulate: Simulate, cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray
) -> AnyArray:
    """What `simulate` gives, as a NumPy array of the precision of u."""
    with jax.enable_x64(u.dtype == np.float64):
        return np.asarray(_compiled(simulate, cell, params, window, u))


@partial(jax.jit, static_argnums=(0, 1))
def _compiled(simulate: Simulate, cell: Any, params: Any, window: Any, u: Any) -> jax.Array:
    return simulate(cell, params, window, u)
