"""Steps of a network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Steps
from asia.errors import UserError
from asia.models._arrays import AnyArray
from asia.models._data.records import window
from asia.models._networks.structure import Cell, OneSample
from asia.models._steps.shared import mean, turned

if TYPE_CHECKING:
    from asia.models._networks.network import NetworkModel


def network_steps(model: NetworkModel) -> Steps:
    """The mean over the members, each in single precision as the network computes. Raises UserError
    before training and for a structure that cannot go sample by sample."""
    import jax

    cell: Any = model.cell
    scaling = model.scaling
    if scaling is None:
        raise UserError("network model: not trained yet; call train before as_steps")
    if not isinstance(cell, Cell | OneSample):
        raise UserError(f"{type(cell).__name__} has no form that goes sample by sample")
    scanned = isinstance(cell, Cell)
    begin, advance = (cell.initial, cell.step) if scanned else (cell.begin, cell.advance)
    # As JAX arrays, so that what depends on parameters alone is found by the same functions.
    members = [jax.tree.map(jax.numpy.asarray, p) for p in (model.params, *model.others)]

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        del u
        past = window(scaling.inputs(past_u)[None], scaling.outputs(past_y)[None])
        return [begin(p, past.astype(np.float32)) for p in members]

    def step(states: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        v = scaling.inputs(u).astype(np.float32)[None]
        after: list[Any] = []
        outputs: list[AnyArray] = []
        for params, state in zip(members, states, strict=True):
            state, features = advance(params, state, v)
            after.append(state)
            outputs.append(cell.output(params, features, v).astype(np.float64))
        return after, scaling.physical(mean(outputs)[0])

    return turned(Steps(initial, step), model.turns)
