"""Fitted neural state-space model, and its simulation."""

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
from asia.models._arrays import AnyArray, bounded, namespace, scan
from asia.models._data.encoder import Encoder
from asia.models._data.records import delayed, window
from asia.models._data.scaling import Scaling
from asia.models._data.turns import SignalTurns
from asia.models._networks.simulation import outputs_of
from asia.models._state_space.past_fit import PastFit, fitted_state
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._steps import first_of_line, median, through_line


@dataclass(frozen=True)
class FittedStateSpace:
    """Result of training a neural state-space model."""

    structure: StateSpaceStructure
    """Equations of the model."""
    members: tuple[tuple[dict[str, Any], Encoder], ...]
    """Parameters as `StateSpaceStructure` reads them, in z-scores, and the map from the past
    window to the initial state."""
    delay: int
    """Delay of the inputs, in samples."""
    scaling: Scaling
    """Scaling from physical units to z-scores."""
    turns: SignalTurns | None = None
    """Symmetries over which simulations are averaged; None: none."""
    starts: tuple[PastFit, ...] = ()
    """Fit of the initial state of each member to the past window; () where the encoder gives it."""
    transport: Transport | None = None
    """Transport of the inputs to their place of action; None: at once."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units: past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B,
        H, nu) -> (B, H, ny)."""
        if self.transport is not None:
            past_u, u = carried_windows(self.transport, past_u, u)
        if self.turns is None:
            return self._simulated(past_u, past_y, u)
        return self.turns.averaged(self._simulated, past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """States of the members and the inputs that the delay holds back; before them the
        content of the pipe, where there is one."""
        if self.transport is not None:
            pipe, leaving, acting = _entered(self.transport, past_u, u)
            return pipe, replace(self, transport=None).initial(leaving, past_y, acting)
        if self.turns is not None:
            return self.turns.initial(replace(self, turns=None), past_u, past_y, u)
        past, first = self.scaling.inputs(past_u), self.scaling.inputs(u)
        starts = self._starts(past, self.scaling.outputs(past_y), first)
        return starts, first_of_line(past, first, self.delay)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; the output is the median over the members."""
        if self.transport is not None:
            pipe, inner = state
            pipe, acting = _through(self.transport, pipe, u)
            inner, y = replace(self, transport=None).step(inner, acting)
            return (pipe, inner), y
        if self.turns is not None:
            return self.turns.step(replace(self, turns=None), state, u)
        structure, (states, line) = self.structure, state
        line, acting = through_line(line, self.scaling.inputs(u))
        after, outputs = list[AnyArray](), list[AnyArray]()
        for x, (params, _) in zip(states, self.members, strict=True):
            x, w = structure.split(params, x, structure.input(params, acting))
            after.append(x)
            outputs.append(structure.output(params, w))
        return (after, line), self.scaling.physical(median(outputs))

    def _starts(self, past: AnyArray, y: AnyArray, u: AnyArray) -> list[AnyArray]:
        """State of each member (B, n) at the first sample.

        Args:
            past: z-scored past inputs (B, n_past_u, nu).
            y: z-scored past outputs (B, n_past_y, ny).
            u: first input (B, nu).
        """
        features = window(past, y)
        if self.structure.lags is not None:
            return [features @ self.structure.lags.selection()] * len(self.members)
        known = namespace(past, u).concatenate([past, u[:, None]], axis=1)
        states: list[AnyArray] = []
        for i, (params, encoder) in enumerate(self.members):
            x = encoder(features)
            if i < len(self.starts):
                how = self.starts[i]
                rows = np.arange(past.shape[1] - how.samples, past.shape[1] + 1) - self.delay
                held = known[:, np.maximum(rows, 0)]
                x = fitted_state(self.structure, params, how, x, held, y[:, -how.samples :])
            states.append(x)
        return states

    def _simulated(self, past_u: Array, past_y: Array, u: Array) -> Array:
        past, future = self.scaling.inputs(past_u), self.scaling.inputs(u)
        starts = self._starts(past, self.scaling.outputs(past_y), future[:, 0])
        inputs, cell = delayed(past, future, self.delay), _StartedCell(self.structure)
        outputs = [
            outputs_of(cell, params, x, inputs)
            for (params, _), x in zip(self.members, starts, strict=True)
        ]
        return self.scaling.physical(median(outputs))


@dataclass(frozen=True)
class StateCell:
    """Cell of the model for Adam and for simulation: see `asia.models._networks.structure.Cell`."""

    structure: StateSpaceStructure
    """Equations of the model."""

    def initial(self, params: Any, window: AnyArray) -> AnyArray:
        """State from the encoder, or the past window itself."""
        if self.structure.lags is not None:
            return window @ self.structure.lags.selection().astype(window.dtype)
        p = params["encoder"]
        bent = namespace(window).tanh(window @ p["inner"] + p["shift"])
        return window @ p["weights"] + bent @ p["outer"] + p["bias"]

    def step(self, params: Any, state: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Next state and output before r."""
        return self.structure.split(params, state, self.structure.input(params, u))

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output after the static function r."""
        del u
        return self.structure.output(params, features)


@dataclass(frozen=True)
class _StartedCell(StateCell):
    """Cell of the model that receives its states in place of the past window."""

    def initial(self, params: Any, window: AnyArray) -> AnyArray:
        """Return the states."""
        del params
        return window


def carried_windows(transport: Transport, past_u: Array, u: Array) -> tuple[Array, Array]:
    """Inputs of the past window (B, n_past_u, nu) and after it (B, H, nu) at the outlet of the
    pipe, with the pace as an additional input."""
    known = np.concatenate([past_u, u], axis=1)
    leaving = np.stack([transport.carried(one) for one in known])
    return leaving[:, : past_u.shape[1]], leaving[:, past_u.shape[1] :]


def carried_records(
    records: Sequence[Trajectory], context: Context, pace: int
) -> tuple[Transport, list[Trajectory], Context]:
    """Estimate the pipe from records.

    Returns:
        The pipe, the records at its outlet, and their context.

    Raises:
        UserError: if input `pace` has values that are not positive.
    """
    try:
        transport = find_transport(records, pace).transport
    except ValueError as error:
        raise UserError(f"neural_ss.Config: {error}; set transport to None") from error
    name = context.inputs[pace]
    inputs = (*context.inputs, Signal(f"{name.name}, not carried", name.unit))
    behind = [replace(r, u=transport.carried(r.u)) for r in records]
    return transport, behind, replace(context, inputs=inputs)


def _entered(transport: Transport, past_u: AnyArray, u: AnyArray) -> tuple[Any, AnyArray, AnyArray]:
    """Fill the pipe from the past window.

    The pipe holds the inputs of the samples in which its content entered (B, length, nu), the
    oldest
    first, and the amounts (B, length) that have passed since these began.

    Returns:
        The pipe at the first sample, its outlet during the past window (B, n_past_u, nu + 1), and
        its outlet at the first sample (B, nu + 1).
    """
    xp, length = namespace(past_u, u), transport.longest + 1
    first = past_u[:, 0] if past_u.shape[1] else u
    pace = xp.maximum(first[:, transport.pace], transport.least_pace)
    pipe = xp.repeat(first[:, None], length, axis=1), pace[:, None] * np.arange(length, 0.0, -1.0)
    leaving: AnyArray = xp.zeros((len(u), 0, u.shape[1] + 1))
    if past_u.shape[1]:
        pipe, leaving = scan(partial(_through, transport), pipe, past_u.swapaxes(0, 1))
        leaving = leaving.swapaxes(0, 1)
    return pipe, leaving, _through(transport, pipe, u)[1]


def _through(transport: Transport, pipe: Any, u: AnyArray) -> tuple[Any, AnyArray]:
    """Advance the pipe by inputs u (B, nu); its outlet during this sample is (B, nu + 1). One
    sample of `Transport.carried`."""
    xp, (held, since) = namespace(u), pipe
    pace = xp.maximum(u[:, transport.pace], transport.least_pace)[:, None]
    known = xp.concatenate([held, u[:, None]], axis=1)
    began = xp.concatenate([since, xp.zeros_like(pace)], axis=1)
    amount = xp.concatenate([since[:, :-1] - since[:, 1:], since[:, -1:], pace], axis=1)

    def left(most: AnyArray) -> AnyArray:
        """Share of each sample's amount that lies further back than this amount."""
        return bounded((began - most) / amount, 0.0, 1.0)

    share = left(transport.volume - pace) - left(np.asarray(transport.volume))
    mixed = (share[:, :, None] * known).sum(axis=1) / share.sum(axis=1)[:, None]
    acting = xp.concatenate([mixed, u[:, transport.pace, None]], axis=1)
    return (known[:, 1:], began[:, 1:] + pace), acting
