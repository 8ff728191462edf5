"""What training a neural state-space model found, and its simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.data._transport import Transport, find_transport
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._data.encoder import Encoder, affine
from asia.models._data.records import delayed, window
from asia.models._data.scaling import Scaling
from asia.models._data.turns import SignalTurns
from asia.models._networks.simulation import outputs_of
from asia.models._state_space.past_fit import PastFit, fitted_state
from asia.models._state_space.structure import StateSpaceStructure


@dataclass(frozen=True)
class FittedStateSpace:
    """What training found."""

    structure: StateSpaceStructure
    """Equations of the model."""
    members: tuple[tuple[dict[str, Any], Encoder], ...]
    """Parameters as `StateSpaceStructure` reads them, in z-scores, and the map from the past
    window to the initial state."""
    delay: int
    """Of the inputs, in samples."""
    scaling: Scaling
    """From physical units to z-scores."""
    turns: SignalTurns | None = None
    """Symmetries over which simulations are averaged; None: none."""
    starts: tuple[PastFit, ...] = ()
    """How the initial state of each member is fitted to the past window; () where the encoder gives
    it."""
    transport: Transport | None = None
    """How inputs are carried to where they act; None: at once."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu), physical units ->
        (B, H, ny)."""
        if self.transport is not None:
            past_u, u = carried_windows(self.transport, past_u, u)
        simulate = partial(_simulated, self)
        if self.turns is None:
            return simulate(past_u, past_y, u)
        return self.turns.averaged(simulate, past_u, past_y, u)


@dataclass(frozen=True)
class StateCell:
    """The model as Adam trains it and as it is simulated: see
    `asia.models._networks.structure.Cell`."""

    structure: StateSpaceStructure
    """Equations of the model."""

    def initial(self, params: Any, window: AnyArray) -> AnyArray:
        """Encoder, or the past window itself."""
        if self.structure.lags is not None:
            return window @ self.structure.lags.selection().astype(window.dtype)
        p = params["encoder"]
        bent = namespace(window).tanh(window @ p["inner"] + p["shift"])
        return window @ p["weights"] + bent @ p["outer"] + p["bias"]

    def step(self, params: Any, state: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Next state and output before r."""
        return self.structure.split(params, state, self.structure.input(params, u))

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """r."""
        del u
        return self.structure.output(params, features)


def _simulated(f: FittedStateSpace, past_u: Array, past_y: Array, u: Array) -> Array:
    past, future = f.scaling.inputs(past_u), f.scaling.inputs(u)
    features = window(past, f.scaling.outputs(past_y))
    inputs = delayed(past, future, f.delay)
    cell = StateCell(f.structure)
    outputs = [
        outputs_of(cell, {**params, "encoder": vars(encoder)}, features, inputs)
        for params, encoder in f.members[len(f.starts) :]
    ]
    known = np.concatenate([past, future[:, :1]], axis=1)
    for (params, encoder), how in zip(f.members, f.starts, strict=False):
        rows = np.arange(past.shape[1] - how.samples, past.shape[1] + 1) - f.delay
        u, y = known[:, np.maximum(rows, 0)], f.scaling.outputs(past_y)[:, -how.samples :]
        x = fitted_state(f.structure, params, how, encoder(features), u, y)
        outputs.append(
            outputs_of(cell, {**params, "encoder": vars(_identity(x.shape[1]))}, x, inputs)
        )
    return f.scaling.physical(np.median(outputs, axis=0))


def _identity(states: int) -> Encoder:
    return affine(np.eye(states), np.zeros(states))


def carried_windows(transport: Transport, past_u: Array, u: Array) -> tuple[Array, Array]:
    """Inputs of the past window (B, n_past_u, nu) and after it (B, H, nu), as they leave the
    pipe, with the pace as one input more."""
    known = np.concatenate([past_u, u], axis=1)
    leaving = np.stack([transport.carried(one) for one in known])
    return leaving[:, : past_u.shape[1]], leaving[:, past_u.shape[1] :]


def carried_records(
    records: Sequence[Trajectory], context: Context, pace: int
) -> tuple[Transport, list[Trajectory], Context]:
    """The pipe that these records show, and the records and their context behind it. Raises
    UserError where input `pace` has values that are not positive."""
    try:
        transport = find_transport(records, pace).transport
    except ValueError as error:
        raise UserError(f"neural_ss.Config: {error}; set transport to None") from error
    name = context.inputs[pace]
    inputs = (*context.inputs, Signal(f"{name.name}, not carried", name.unit))
    behind = [replace(r, u=transport.carried(r.u)) for r in records]
    return transport, behind, replace(context, inputs=inputs)
