"""Trace a fitted model with JAX and lower it to programs.

Tracing runs where the candidate runs; the result is bytes, which `wire` reads in the parent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from asia.data import Array
from asia.lowering import rules, wire
from asia.lowering.building import CannotLowerError, Values, number
from asia.lowering.ops import Shape, ShapeError
from asia.lowering.program import Builder, LoweredModel, Program


def lowered_bytes(model: object, n_past_u: int, n_past_y: int, nu: int, ny: int) -> bytes:
    """Lower a model; return it packed by `wire.pack`, or the reason why it cannot be lowered."""
    import jax

    # Set before the model makes arrays of its numbers.
    jax.config.update("jax_enable_x64", True)
    if not all(callable(getattr(model, name, None)) for name in ("initial", "step")):
        return wire.pack_refusal(
            f"{type(model).__name__} has no initial() and step(): give the model both methods of "
            "asia.candidate.StepModel"
        )
    try:
        return wire.pack(lowered(model, n_past_u, n_past_y, nu, ny))
    except CannotLowerError as error:
        return wire.pack_refusal(str(error))
    except ShapeError as error:
        return wire.pack_refusal(f"the steps do not fit together: {error}")
    except Exception as error:  # noqa: BLE001 - the border to candidate code
        return wire.pack_refusal(f"tracing the steps raised {type(error).__name__}: {error}")


def lowered(model: Any, n_past_u: int, n_past_y: int, nu: int, ny: int) -> LoweredModel:
    """Lower an `asia.candidate.StepModel` to programs for one case; jax_enable_x64 must be on.

    Raises:
        CannotLowerError: with the obstacle.
    """
    import jax

    def begin(*signals: Any) -> Any:
        return jax.tree.map(_row, model.initial(*(signal[None] for signal in signals)))

    window = [_like((n_past_u, nu)), _like((n_past_y, ny)), _like((nu,))]
    start, state = _traced(begin, window)
    leaves, tree = jax.tree.flatten(state)
    # Empty arrays are no states.
    kept = [i for i, leaf in enumerate(leaves) if leaf.size]

    def step(*signals: Any) -> Any:
        given = [jax.numpy.zeros(leaf.shape, leaf.dtype) for leaf in leaves]
        for place, signal in zip(kept, signals[:-1], strict=True):
            given[place] = signal
        state = jax.tree.unflatten(tree, [leaf[None] for leaf in given])
        after, y = model.step(state, signals[-1][None])
        found, shape = jax.tree.flatten(after)
        if shape != tree:
            raise CannotLowerError("step gives a state of another structure than it takes")
        return [_row(y), *(_row(found[i]) for i in kept)]

    one, _ = _traced(step, [*(leaves[i] for i in kept), _like((nu,))])
    programs = [_program(start, kept), _program(one)]
    single = any(rules.in_single_precision(p.jaxpr) for p in (start, one))
    return LoweredModel(n_past_u, n_past_y, nu, ny, single, *programs)


def _row(batch: Any) -> Any:
    """Only row of a batch."""
    import jax

    batch = jax.numpy.asarray(batch)
    if batch.shape[:1] != (1,):
        raise CannotLowerError(
            f"an output or a state has shape {batch.shape} for a batch of 1: the batch comes first"
        )
    return batch.reshape(batch.shape[1:])


def _like(shape: Shape) -> Any:
    import jax

    return jax.ShapeDtypeStruct(shape, np.float64)


def _traced(function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, Any]:
    import jax

    return jax.make_jaxpr(function, return_shape=True)(*arguments)


def _program(closed: Any, kept: Sequence[int] | None = None) -> Program:
    build = Builder(tuple(v.aval.shape for v in closed.jaxpr.invars))
    given: Values = list(range(len(build.inputs)))
    found = rules.Lowering(build).run(closed.jaxpr, closed.consts, given)
    chosen = found if kept is None else [found[i] for i in kept]
    return build.program([number(build, v) for v in chosen])


__all__ = ["Array", "lowered", "lowered_bytes"]
