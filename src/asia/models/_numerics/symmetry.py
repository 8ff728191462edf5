"""Symmetries of a black box: transformations of its inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import Context, StepModel
from asia.data.trajectory import Array, Mask, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData, ScaledTrajectory, scaled
from asia.models._steps import mean
from asia.problem.symmetry import group, of_signals

SimulateWindows = Callable[[Array, Array, Array], Array]
"""Type of the `simulate` of a model."""


@dataclass(frozen=True)
class SignalTransformations:
    """Group of the symmetries that map inputs to inputs and outputs to outputs, identity first."""

    inputs: Array  # Transformations of the inputs (G, nu, nu), signed permutations
    outputs: Array  # Transformations of the outputs (G, ny, ny)

    @classmethod
    def of(cls, context: Context) -> SignalTransformations:
        """Group of a problem. Raises UserError if it has no such symmetry."""
        inputs, outputs = ([s.name for s in side] for side in (context.inputs, context.outputs))
        usable = of_signals(context.symmetry, inputs, outputs)
        if not usable:
            raise UserError(
                "symmetry is on, but no [symmetry] of the problem takes inputs to inputs and "
                "outputs to outputs and names nothing else; declare one or leave symmetry off"
            )
        elements = group(usable, [*inputs, *outputs])
        nu = len(inputs)
        return cls(elements[:, :nu, :nu], elements[:, nu:, nu:])

    def __len__(self) -> int:
        return len(self.inputs)

    def turned(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        """Each record, followed by its transformations."""
        return [
            replace(t, u=t.u @ turn_u.T, y=t.y @ turn_y.T, missing=_turned(~t.measured, turn_y))
            for t in trajectories
            for turn_u, turn_y in self._elements()
        ]

    def transformed_scores(self, records: ScaledData) -> list[ScaledTrajectory]:
        """Each record in z-scores of transformed records, followed by its transformations, which
        keep the z-scores."""
        return [
            replace(
                r,
                u=r.u @ turn_u.T,
                y=r.y @ turn_y.T,
                undelayed_u=r.undelayed_u @ turn_u.T,
                weight=1.0 - _turned(r.weight == 0, turn_y),
                counts=1.0 - _turned(r.counts == 0, turn_y),
            )
            for r in records
            for turn_u, turn_y in self._elements()
        ]

    def _elements(self) -> Iterator[tuple[Array, Array]]:
        return zip(self.inputs, self.outputs, strict=True)

    def averaged(self, simulate: SimulateWindows, past_u: Array, past_y: Array, u: Array) -> Array:
        """Average over the group: simulate the transformed signals and transform the outputs back.

        The mean has the symmetries exactly, whatever `simulate` has learned.
        """
        count = len(u)
        turned = (
            np.concatenate([signal @ turn.T for turn in turns])
            for signal, turns in ((past_u, self.inputs), (past_y, self.outputs), (u, self.inputs))
        )
        found = simulate(*turned).reshape(len(self), count, u.shape[1], -1)
        return np.mean([y @ turn for y, turn in zip(found, self.outputs, strict=True)], axis=0)

    def initial(self, model: StepModel, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """States of `averaged`, one for each element."""
        return [
            model.initial(past_u @ turn_u.T, past_y @ turn_y.T, u @ turn_u.T)
            for turn_u, turn_y in self._elements()
        ]

    def step(self, model: StepModel, states: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance `averaged` by one sample."""
        after, outputs = list[Any](), list[AnyArray]()
        for state, (turn_u, turn_y) in zip(states, self._elements(), strict=True):
            state, y = model.step(state, u @ turn_u.T)
            after.append(state)
            outputs.append(y @ turn_y)
        return after, mean(outputs)


def _turned(missing: Mask, turn: Array) -> Mask:
    return missing @ (turn.T != 0)


@dataclass(frozen=True)
class TransformedRecords:
    """Records of a fit, with their transformations by symmetries of the system."""

    records: ScaledData  # Records as measured, for choices by held-out parts
    scaling: Scaling
    """Scaling: the same for signals that a symmetry exchanges, and about zero for one that it
    negates."""
    turns: SignalTransformations | None  # Symmetries; None: none

    @classmethod
    def of(
        cls, trajectories: Sequence[Trajectory], turns: SignalTransformations | None
    ) -> TransformedRecords:
        """Scale records in physical units."""
        every = trajectories if turns is None else turns.turned(trajectories)
        scaling = Scaling.of(every)
        return cls(scaled(trajectories, scaling), scaling, turns)

    @property
    def copies(self) -> int:
        """Number of copies of each record in `every`."""
        return 1 if self.turns is None else len(self.turns)

    @property
    def every(self) -> ScaledData:
        """Each record followed by its transformed copies."""
        return self.with_transformed(self.records)

    def with_transformed(self, records: ScaledData) -> ScaledData:
        """Each of these records followed by its transformed copies."""
        return records if self.turns is None else self.turns.transformed_scores(records)
