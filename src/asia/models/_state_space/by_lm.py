"""Fits of a neural state-space model by Levenberg-Marquardt, with maps from past windows to
states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.models._data.encoder import Encoder
from asia.models._data.records import ScaledData
from asia.models._data.scaling import Scaling
from asia.models._least_squares import LevenbergMarquardt
from asia.models._linear.fit import LinearFit
from asia.models._state_space.fit import StateFit, fit_states, of_records, state_encoder
from asia.models._state_space.past_fit import PastFit, past_fit, window_samples
from asia.models._state_space.pieces import fit_pieces
from asia.models._state_space.starts import starts_of, with_elements
from asia.models._state_space.structure import StateSpaceStructure


@dataclass(frozen=True)
class LmOptions:
    """Options of the fits, apart from the method."""

    ridge: dict[str, float]
    """Ridge of each top-level parameter name."""
    members: int
    """Number of fits that are kept."""
    hidden: int
    """Number of tanh units of the map from past windows to states."""
    pieces: bool
    """Begin the fits with short segments of the records."""
    past_fit: bool
    """Fit initial states to the past window."""
    seed: int
    """Seed of the starts."""


@dataclass(frozen=True)
class FittedMembers:
    """Best fits of a model."""

    members: tuple[tuple[dict[str, Any], Encoder], ...]
    """Parameters, and the map from past windows to states, of each fit."""
    starts: tuple[PastFit, ...]
    """Fits of the initial states to the past window; () where the map gives them."""
    cost: float
    """Least cost."""


def fit_members(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    scaling: Scaling,
    context: Context,
    method: LevenbergMarquardt,
    options: LmOptions,
) -> FittedMembers:
    """Fit from `method.starts` starting points, one where all are the same. Each start simulates
    as the linear model."""
    rng = np.random.default_rng(options.seed)
    count = method.starts if structure.starts_vary else 1
    starts = starts_of(structure, found, records, count, scaling, rng)
    ridge = {**options.ridge, "x0": found.error / sum(len(r) for r in records)}
    samples = of_records(records, with_elements(structure, found).x0)
    log, time = context.log, context.sampling_time
    fits = list[StateFit]()
    if options.pieces:
        before = fit_pieces(
            structure, found.system, starts, records, samples.x0, ridge, method, log, time
        )
        begin, x0 = [one.params for one in before], [one.x0 for one in before]
        fits = fit_states(structure, starts, samples, ridge, method, log, time, begin=begin, x0=x0)
        # One start begins with whole records, since segments may mislead too.
        starts = starts[:1]
    fits += fit_states(structure, starts, samples, ridge, method, log, time)
    fits.sort(key=lambda one: one.cost)
    members, how = list[tuple[dict[str, Any], Encoder]](), list[PastFit]()
    for one in fits[: options.members]:
        if options.past_fit and window_samples(context):
            encoder, fitted = past_fit(structure, one, records, context, options.hidden)
            how.append(fitted)
        else:
            encoder = state_encoder(structure, one, records, context, options.hidden)
        members.append((one.params, encoder))
    return FittedMembers(tuple(members), tuple(how), fits[0].cost)
