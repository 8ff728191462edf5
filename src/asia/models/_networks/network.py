"""Model of a network family: a structure, its parameters and the scaling of its signals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._data.chunks import laid, whole
from asia.models._data.records import ScaledData, batch, check, window
from asia.models._data.scaling import Scaling
from asia.models._data.turns import SignalTurns, TurnedData
from asia.models._networks.simulation import features_of, outputs_of
from asia.models._networks.structure import (
    Cell,
    NetworkStructure,
    OneSample,
    Params,
    Restartable,
    SequenceMap,
)
from asia.models._steps import mean
from asia.models.methods import NetworkMethod

Prepare = Callable[[Params, ScaledData, Scaling], Params]
"""Function that makes the initial parameters from z-scored records: for example a linear fit."""


@dataclass(frozen=True)
class NetworkModel:
    """Network as a model."""

    cell: NetworkStructure
    """Structure of the network."""
    params: Params
    """Parameters of the network."""
    scaling: Scaling | None = None
    """Scaling from physical units to z-scores; None before training."""
    others: tuple[Params, ...] = ()
    """Parameters of further members, whose simulations are averaged with that of `params`."""
    turns: SignalTurns | None = None
    """Symmetries over which simulations are averaged; None: none."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny), float64.

        Raises:
            UserError: before training.
        """
        if self.turns is None:
            return self._simulated(past_u, past_y, u)
        return self.turns.averaged(self._simulated, past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training, and for a structure that cannot go sample by sample.
        """
        if self.turns is not None:
            return self.turns.initial(replace(self, turns=None), past_u, past_y, u)
        scaling, cell = self._scaling(), self._sequential()
        past = window(scaling.inputs(past_u), scaling.outputs(past_y)).astype(np.float32)
        begin = cell.initial if isinstance(cell, Cell) else cell.begin
        return [begin(params, past) for params in self._members(past)]

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample; the output is the mean over the members, each in single
        precision as the network computes."""
        if self.turns is not None:
            return self.turns.step(replace(self, turns=None), state, u)
        scaling, cell = self._scaling(), self._sequential()
        advance = cell.step if isinstance(cell, Cell) else cell.advance
        v = scaling.inputs(u).astype(np.float32)
        after, outputs = list[Any](), list[AnyArray]()
        for params, member in zip(self._members(v), state, strict=True):
            member, features = advance(params, member, v)
            after.append(member)
            outputs.append(cell.output(params, features, v).astype(np.float64))
        return after, scaling.physical(mean(outputs))

    def _sequential(self) -> Cell | OneSample:
        if not isinstance(self.cell, Cell | OneSample):
            raise UserError(f"{type(self.cell).__name__} has no form that goes sample by sample")
        return self.cell

    def _members(self, like: AnyArray) -> list[Params]:
        members = [self.params, *self.others]
        if namespace(like) is np:
            return members
        import jax

        # The parts that depend only on parameters are then found by the same functions.
        return [jax.tree.map(jax.numpy.asarray, params) for params in members]

    def _scaling(self) -> Scaling:
        if self.scaling is None:
            raise UserError("network model: not trained yet; call train first")
        return self.scaling

    def _simulated(self, past_u: Array, past_y: Array, u: Array) -> Array:
        scaling = self._scaling()
        past = window(scaling.inputs(past_u), scaling.outputs(past_y))
        arrays = past.astype(np.float32), scaling.inputs(u).astype(np.float32)
        members = (self.params, *self.others)
        outputs = [np.asarray(outputs_of(self.cell, p, *arrays), np.float64) for p in members]
        return scaling.physical(mean(outputs))


def train_network(
    model: NetworkModel,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: NetworkMethod,
    prepare: Prepare | None = None,
) -> NetworkModel:
    """Fit a network to the simulation error.

    Args:
        model: untrained network.
        trajectories: training records.
        context: context of the fit.
        method: training method.
        prepare: makes the initial parameters; None solves the output layer `out_w`, `out_b` by
            ridge regression where the structure reads it as `linear_output` does.

    Raises:
        UserError: for records too short or mis-shaped, and for a method that does not go with the
            structure.
    """
    from asia.models._networks.training import fit  # imports JAX, which a simulation must not

    check(trajectories, context)
    data = TurnedData.of(trajectories, SignalTurns.of(context) if method.symmetry else None)
    every, scaling, turns = data.every, data.scaling, data.turns
    cell = model.cell
    if method.members > 1 and not isinstance(cell, Restartable):
        raise UserError(
            f"{type(method).__name__}: members is {method.members}, but this family starts from "
            "its data and not from a seed; leave members at 1"
        )
    members: list[Params] = []
    # Members are trained sequentially by one compiled program: three in parallel, by jax.vmap, take
    # 0.8 times as long where 8 short chunks are side by side, but 1.0 to 1.25 times where 31 are.
    for i in range(method.members):
        params, own = model.params, replace(context, seed=context.seed + i)
        if i > 0 and isinstance(cell, Restartable):
            params = cell.parameters(own)
        if prepare is None:
            params = with_output_layer(cell, params, every, context)
        else:
            params = prepare(params, data.records, scaling)
        trained = fit(
            cell,
            params,
            every,
            own,
            method,
            lambda p: NetworkModel(cell, p, scaling, turns=turns),
            data.copies,
        )
        members.append(trained)
    return NetworkModel(cell, members[0], scaling, tuple(members[1:]), turns)


def as_built(params: Params, records: ScaledData, scaling: Scaling) -> Params:
    """Return the parameters unchanged: a `Prepare` for families that start from random weights."""
    del records, scaling
    return params


def with_output_layer(
    cell: NetworkStructure, params: Params, records: ScaledData, context: Context
) -> Params:
    """Solve the output layer by ridge regression on the untrained states; return the parameters
    unchanged where there is no such layer."""
    if "out_w" not in params or (isinstance(cell, SequenceMap) and not isinstance(cell, Cell)):
        return params
    samples = batch(records, context)
    data = whole(samples) if context.horizon is None else laid(samples, context.horizon)
    traced = features_of(cell, params, data.window, data.u)
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
