"""Fits of linear systems with static functions in feedback, from several linear models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from asia.candidate import Context
from asia.models._arrays import tree_size
from asia.models._data.records import ScaledData
from asia.models._data.scaling import Scaling
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import LinearFit
from asia.models._state_space.feedback.starts import feedback_starts
from asia.models._state_space.fit import StateFit, fit_states, of_records, state_encoder
from asia.models._state_space.fitted import FittedStateSpace
from asia.models._state_space.past_fit import past_fit, window_samples
from asia.models._state_space.pieces import fit_pieces
from asia.models._state_space.structure import StateSpaceStructure

_LINEAR, _FUNCTIONS = ("a", "b", "c", "d", "offset"), ("f", "read", "act")
# Share of the iterations that every start gets, and number of starts that are continued.
_TRIED, _GO_ON = 0.25, 2


class LinearCore(NamedTuple):
    """Linear model that fits begin with."""

    found: LinearFit
    """Fitted model."""
    delay: int
    """Delay of its inputs, in samples."""
    records: ScaledData
    """Records of its fit, inputs delayed."""


@dataclass(frozen=True)
class FeedbackOptions:
    """Options of the fits, apart from the method."""

    channels: int
    """Number of signals that the functions read, and of those that they give."""
    hidden: int
    """Number of tanh units."""
    ridge: float
    """Ridge of the functions."""
    linear_ridge: float
    """Ridge of the linear system."""
    encoder: int
    """Number of tanh units of the map from past windows to states."""
    integrators: int
    """Number of states whose pole is held at 1."""
    pieces: bool
    """Begin the fits with short segments of the records."""


class _Fit(NamedTuple):
    """Unfinished fit."""

    core: LinearCore
    structure: StateSpaceStructure
    start: dict[str, object]
    now: StateFit
    expected_error: float
    """Final prediction error: estimate of the error on new records."""


def fit_feedback(
    cores: Sequence[LinearCore],
    options: FeedbackOptions,
    scaling: Scaling,
    context: Context,
    method: LevenbergMarquardt,
) -> FittedStateSpace:
    """Best of the fits from `method.starts` starts for each linear model."""
    fits = _Fits(options, context, method)
    tried = sorted(
        (one for core in cores for one in fits.begun(core)), key=lambda t: t.expected_error
    )
    best = min((fits.ended(one) for one in tried[:_GO_ON]), key=lambda t: t.expected_error)
    each = best.structure, best.now, best.core.records, context, options.encoder
    if window_samples(context):
        encoder, how = past_fit(*each)
        starts = (how,)
    else:
        encoder, starts = state_encoder(*each), ()
    members = ((best.now.params, encoder),)
    return FittedStateSpace(best.structure, members, best.core.delay, scaling, None, starts)


class _Fits:
    """Fits of one model, with their common settings."""

    def __init__(
        self, options: FeedbackOptions, context: Context, method: LevenbergMarquardt
    ) -> None:
        self.options, self.context, self.method = options, context, method
        first = max(1, round(_TRIED * method.iterations))
        self.first = replace(method, iterations=first, noise_model="white")
        self.rest = replace(method, iterations=max(0, method.iterations - first))

    def begun(self, core: LinearCore) -> list[_Fit]:
        """Run the first iterations from each start."""
        structure = self._structure(core)
        rng = np.random.default_rng(self.context.seed)
        starts = feedback_starts(structure, core.found, core.records, self.method.starts, rng)
        begin = [StateFit(core.found.x0, start, np.inf, np.zeros(0)) for start in starts]
        if self.options.pieces:
            begin = fit_pieces(
                structure, core.found.system, starts, core.records, core.found.x0,
                self._ridges(core), self.first, self.context.log, self.context.sampling_time,
            )  # fmt: skip
        both = zip(starts, begin, strict=True)
        return [self._fitted(core, structure, s, b, self.first) for s, b in both]

    def ended(self, one: _Fit) -> _Fit:
        """Run the remaining iterations."""
        return self._fitted(one.core, one.structure, one.start, one.now, self.rest)

    def _structure(self, core: LinearCore) -> StateSpaceStructure:
        o, order = self.options, core.found.system.order
        nu, ny = self.context.nu, self.context.ny
        return StateSpaceStructure(
            order, nu, ny, "state", "tanh", o.hidden, 2, o.channels, integrators=o.integrators
        )

    def _ridges(self, core: LinearCore) -> dict[str, float]:
        ridge = dict.fromkeys(_LINEAR, self.options.linear_ridge)
        ridge |= dict.fromkeys(_FUNCTIONS, self.options.ridge)
        return {**ridge, "x0": core.found.error / sum(len(r) for r in core.records)}

    def _fitted(
        self,
        core: LinearCore,
        structure: StateSpaceStructure,
        start: dict[str, object],
        now: StateFit,
        method: LevenbergMarquardt,
    ) -> _Fit:
        """Continue a fit; the ridge holds it to its start."""
        samples = of_records(core.records, core.found.x0)
        one = fit_states(
            structure, [start], samples, self._ridges(core), method, self.context.log,
            self.context.sampling_time, [now.params], [now.x0],
        )[0]  # fmt: skip
        count = sum(float(r.weight.sum()) for r in core.records) * structure.ny
        # Akaike's final prediction error penalises further states.
        p = min(float(tree_size(one.params)), 0.9 * count)
        return _Fit(core, structure, start, one, one.cost * (count + p) / (count - p))
