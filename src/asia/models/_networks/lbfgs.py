"""Training by `methods.LBFGS`: SciPy's L-BFGS-B on a compiled loss and gradient.

It is in double precision: the line search compares losses that differ in the last digits of a
float32.
"""

from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from asia.models._arrays import Packing, packed
from asia.models._networks.adam import joined, merged, split
from asia.models._networks.monitor import Monitor, marks
from asia.models._networks.objective import NoiseWeighting, Number, objective
from asia.models._networks.structure import NetworkStructure, Params, rollout
from asia.models._numerics.segments import laid, whole
from asia.models._numerics.training_records import SegmentBatch
from asia.models.methods import LBFGS, Loss

Vector: TypeAlias = np.ndarray[Any, Any]


def run(
    cell: NetworkStructure,
    params: Params,
    batch: SegmentBatch,
    method: LBFGS,
    horizon: int | None,
    steps: int,
    monitor: Monitor,
    whiten: NoiseWeighting | None = None,
) -> Params:
    """Train for `steps` iterations, or for as many as `monitor` allows, or until no step lowers the
    loss.

    A point where the loss is not finite is never taken.
    """
    length = method.truncation or horizon
    trained, fixed = split(params)
    packing = Packing.of(trained)
    data = _double(whole(batch) if length is None else laid(batch, length))
    whiten = None if whiten is None else _double(whiten)
    value_of = partial(
        _value, cell, method.loss, packing, method.ridge, data, _double(fixed), whiten
    )
    # The best point, and its loss.
    best, lowest = packed(trained, np.float64), float("inf")

    def loss_and_gradient(x: Vector) -> tuple[float, Vector]:
        nonlocal best, lowest
        loss, slope = value_of(x)
        value, gradient = float(loss), np.asarray(slope, np.float64)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            # A finite large loss, with which the line search shortens its step.
            return 1e10, np.zeros_like(x)
        if value < lowest:
            best, lowest = np.array(x), value
        return value, gradient

    def current() -> Params:
        return joined(packing.unpack(best.astype(np.float32)), fixed)

    from scipy.optimize import minimize  # loading takes long

    due, taken = set(marks(method, steps)), 0

    def after(_: Vector) -> None:
        nonlocal taken
        taken += 1
        if taken in due:
            monitor(taken, current, lowest)
        if monitor.stopped:
            raise StopIteration

    with jax.enable_x64(True):
        minimize(
            loss_and_gradient, best, jac=True, method="L-BFGS-B", callback=after,
            options={
                "maxiter": steps, "maxcor": method.memory, "maxfun": 20 * steps,
                "ftol": 1e-12, "gtol": 1e-9,
            },
        )  # fmt: skip
    if taken not in due and not monitor.stopped:
        monitor(max(taken, 1), current, lowest)
    return current()


def _double(tree: Any) -> Any:
    """Convert the floats of a tree to double precision."""

    def one(value: Any) -> Any:
        array = np.asarray(value)
        return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array

    return jax.tree.map(one, tree)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _value(
    cell: NetworkStructure,
    loss: Loss,
    packing: Packing,
    ridge: Number,
    data: SegmentBatch,
    fixed: Any,
    whiten: NoiseWeighting | None,
    flat: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    def loss_of(flat: jax.Array) -> jax.Array:
        trained = packing.unpack(flat)
        params = merged(trained, fixed)
        residual = rollout(cell, params, data.window, data.u) - data.y
        penalty = sum(
            (jnp.sum(v**2) for v in jax.tree.leaves(trained) if v.ndim >= 2), jnp.zeros(())
        )
        error = objective(loss, residual, data.weight, None, whiten)
        return error + ridge * penalty

    return jax.value_and_grad(loss_of)(flat)
