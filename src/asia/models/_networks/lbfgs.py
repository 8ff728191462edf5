"""`methods.LBFGS`: SciPy's L-BFGS-B on a compiled loss and gradient.

In double precision: the line search compares losses that differ in the last digits of a float32.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize

from asia.models._data.chunks import Simulations, laid, whole
from asia.models._data.records import PaddedBatch
from asia.models._networks.adam import joined, merged, split
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import objective
from asia.models._networks.structure import NetworkStructure, Params, rollout
from asia.models.methods import LBFGS


def run(
    cell: NetworkStructure,
    params: Params,
    batch: PaddedBatch,
    method: LBFGS,
    horizon: int | None,
    steps: int,
    monitor: Monitor,
) -> Params:
    """The parameters after `steps` iterations, or after those that `monitor` allows, or where no
    step lowers the loss; a point where the loss is not finite is never taken."""
    length = method.truncation or horizon
    with jax.enable_x64(True):
        trained, fixed = split(params)
        flat, unravel = ravel_pytree(jax.tree.map(_double, trained))
        data = jax.tree.map(_double, whole(batch) if length is None else laid(batch, length))
        fixed = jax.tree.map(_double, fixed)
        value_of = partial(_value, cell, method, data, fixed, unravel)
        search = _BestPoint(value_of, np.asarray(flat, np.float64))

        def current() -> Params:
            tree = jax.tree.map(
                lambda v: np.asarray(v, np.float32), unravel(jnp.asarray(search.best))
            )
            return joined(tree, params.get("fixed"))

        due = set(marks(method, steps))
        taken = 0

        def after(_: np.ndarray[Any, Any]) -> None:
            nonlocal taken
            taken += 1
            if taken in due:
                monitor(taken, current, search.loss)
            if monitor.stopped:
                raise StopIteration

        minimize(
            search, search.best, jac=True, method="L-BFGS-B", callback=after,
            options={
                "maxiter": steps, "maxcor": method.memory, "maxfun": 20 * steps,
                "ftol": 1e-12, "gtol": 1e-9,
            },
        )  # fmt: skip
        if taken not in due and not monitor.stopped:
            monitor(max(taken, 1), current, search.loss)
        return current()


class _BestPoint:
    """Loss and gradient for SciPy, remembering the best point."""

    def __init__(self, value_of: Any, start: np.ndarray[Any, Any]) -> None:
        self._value_of = value_of
        self.best = start
        self.loss = float("inf")

    def __call__(self, x: np.ndarray[Any, Any]) -> tuple[float, np.ndarray[Any, Any]]:
        loss, slope = self._value_of(jnp.asarray(x))
        value, gradient = float(loss), np.asarray(slope, np.float64)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            # Finite and large: the line search then shortens its step.
            return 1e10, np.zeros_like(x)
        if value < self.loss:
            self.best, self.loss = np.array(x), value
        return value, gradient


def _double(value: Any) -> Any:
    array = jnp.asarray(value)
    return array.astype(jnp.float64) if jnp.issubdtype(array.dtype, jnp.floating) else array


@partial(jax.jit, static_argnums=(0, 1, 4))
def _value(
    cell: NetworkStructure,
    method: LBFGS,
    data: Simulations,
    fixed: Any,
    unravel: Any,
    flat: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    def loss_of(flat: jax.Array) -> jax.Array:
        trained = unravel(flat)
        params = merged(trained, fixed)
        residual = rollout(cell, params, data.window, data.u) - data.y
        penalty = sum(
            (jnp.sum(v**2) for v in jax.tree.leaves(trained) if v.ndim >= 2), jnp.zeros(())
        )
        loss = objective(method.loss, residual, data.weight, method.washout)
        return loss + method.ridge * penalty

    return jax.value_and_grad(loss_of)(flat)
