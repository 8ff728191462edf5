"""Training of neural state-space models: Levenberg-Marquardt, on segments first."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._config import Progress
from asia.models._least_squares import LevenbergMarquardt, solve_or_fit
from asia.models._linear.fit import LinearFit
from asia.models._linear.system import LinearSystem
from asia.models._numerics.encoder import Encoder
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import (
    ScaledData,
    past_length,
    past_windows_before,
    spread,
)
from asia.models._state_space.fit import (
    StateFit,
    fit_states,
    is_stable,
    of_records,
    state_encoder,
)
from asia.models._state_space.model import (
    PastFit,
    encoder_with_past_fit,
    fitted_state,
    starts_of,
    window_samples,
    with_elements,
)
from asia.models._state_space.programs import StabilityTerm
from asia.models._state_space.structure import StateSpaceStructure

# Fits that begin with short segments of the records, each with its own initial state.
#
# Over a whole record the simulation error of a system in which small differences grow has many
# local minima; over segments it has few. The segments grow to the whole records. Sources: Ribeiro,
# Tiels, Umenberger, Schon and Aguirre, Automatica 121, 2020; Bock, multiple shooting, 1981.


# Lengths of the segments: least number of samples of the first ones, samples for each state of the
# model, factor from one length to the next. Segments of a whole period already miss the minimum of
# a strong oscillator, but elements of friction and play show only in segments with a reversal.
_SMOOTH, _WITH_ELEMENTS = (20, 4, 3), (40, 8, 4)
# Greatest number of segments.
_MOST = 60
# Factors of all ridges, one after the other while the error from past windows is above the limit.
_STIFFER, _LOST = (1.0, 100.0, 1e4), 0.5
# Lengths of segments on which structures are compared.
_COMPARED = 2
# Iterations on segments, the ridge of their states, and that of the first guess of these.
_ITERATIONS, _STATE_RIDGE, _GUESS_RIDGE = 25, 1e-6, 1e-3


class _Segment(NamedTuple):
    """Position of a segment."""

    record: int
    start: int


def fit_segments(
    structure: StateSpaceStructure,
    system: LinearSystem,
    starts: Sequence[dict[str, Any]],
    records: ScaledData,
    x0: Array,
    ridge: dict[str, float],
    method: LevenbergMarquardt,
    log: Progress,
    sampling_time: float,
    lengths: int | None = None,
) -> list[StateFit]:
    """Fit the segments from each start: parameters, and initial states (R, n) of whole records, of
    the first segment of a record, else x0 (R, n), those of the linear system.

    Args:
        structure: equations of the model.
        system: linear system, for the first initial states of the segments.
        starts: parameters that the fits begin with.
        records: whole records.
        x0: initial states of the records.
        ridge: ridge of each top-level parameter name.
        method: settings.
        log: progress.
        sampling_time: in s.
        lengths: number of lengths of segments; None: up to the whole records.
    """
    shortest, by_state, growth = _WITH_ELEMENTS if structure.size > structure.order else _SMOOTH
    length = max(shortest, by_state * structure.size)
    segments = _spread(records, length)
    few = replace(method, iterations=min(method.iterations, _ITERATIONS))
    ridge = {**ridge, "x0": _STATE_RIDGE}
    first = [_guess(structure, system, records, segment, length) for segment in segments]
    states = [np.array(first)] * len(starts)
    # Those of records that are too short for segments.
    fits = [StateFit(x0, start, np.inf, np.zeros(0)) for start in starts]
    begin: Sequence[dict[str, Any]] = starts
    for _ in itertools.count() if lengths is None else range(lengths):
        if not any(2 * len(r) >= 3 * length for r in records):
            break
        cuts = [records[p.record].part(p.start, length) for p in segments]
        fits = [
            fit_states(
                structure, [start], of_records(cuts, known), ridge, few, log, sampling_time,
                begin=[params],
            )[0]
            for start, params, known in zip(starts, begin, states, strict=True)
        ]  # fmt: skip
        begin = [one.params for one in fits]
        length *= growth
        # Segments of this length that do not overlap.
        kept: list[int] = []
        for i, segment in enumerate(segments):
            last = segments[kept[-1]] if kept else None
            if (
                last is None
                or last.record != segment.record
                or segment.start - last.start >= length
            ):
                kept.append(i)
        states = [one.x0[kept] for one in fits]
        # Records begin with the initial states of their first segments.
        opening = [i for i, segment in enumerate(segments) if segment.start == 0]
        for k, one in enumerate(fits):
            whole = x0.copy()
            whole[[segments[i].record for i in opening]] = one.x0[opening]
            fits[k] = one._replace(x0=whole)
        segments = [segments[i] for i in kept]
    return fits


def _spread(records: ScaledData, length: int) -> list[_Segment]:
    """Choose at most `_MOST` successive segments, spread over the records, the first samples of
    each record among them."""
    every = [
        [_Segment(i, start) for start in range(0, max(len(r) - length // 2, 1), length)]
        for i, r in enumerate(records)
    ]
    first = [segments[0] for segments in every[:_MOST]]
    later = [segment for segments in every for segment in segments[1:]]
    room = _MOST - len(first)
    chosen = [later[i] for i in spread(len(later), room)] if later and room else []
    return sorted([*first, *chosen])


def _guess(
    structure: StateSpaceStructure,
    system: LinearSystem,
    records: ScaledData,
    segment: _Segment,
    length: int,
) -> Array:
    """State (n,) from which the linear system simulates the first samples of the segment best."""
    n, few = system.order, min(length, max(10, 3 * system.order))
    part = slice(segment.start, segment.start + few)
    record = records[segment.record]
    u, y, known = record.u[part], record.y[part], record.counts[part].ravel() > 0
    _, forced = system.simulate(np.zeros((1, n)), u[None])
    rows, row = list[Array](), system.c
    for _ in range(len(u)):
        rows.append(row)
        row = row @ system.a
    seen = np.concatenate(rows)[known]
    gram = seen.T @ seen
    held = gram + _GUESS_RIDGE * max(float(np.trace(gram)) / n, 1e-12) * np.eye(n)
    state = solve_or_fit(held, seen.T @ (y - forced[0]).ravel()[known])
    return np.pad(state, (0, structure.size - n))


# Fits of a neural state-space model by Levenberg-Marquardt, with maps from past windows to states.


@dataclass(frozen=True)
class LmOptions:
    """Options of the fits, apart from the method."""

    ridge: dict[str, float]  # Ridge of each top-level parameter name
    pieces: bool  # Begin the fits with short segments of the records
    past_fit: bool  # Fit initial states to the past window


class JudgedFit(NamedTuple):
    """Finished fit, judged as it will be used."""

    params: dict[str, Any]
    encoder: Encoder  # Map from the past window to the initial state
    past_fit: PastFit | None  # Fit of the initial state to the past window
    cost: float
    error: float  # Mean squared error in z-scores of simulations that start from past windows


def fit_best(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    scaling: Scaling,
    context: Context,
    method: LevenbergMarquardt,
    options: LmOptions,
) -> JudgedFit:
    """Best fit from `method.starts` starting points, one where all are the same, by the error from
    past windows. Each start simulates as the linear model.

    A fit with initial states of its own may use an unstable model, which is lost from any other
    state. Fits are repeated with larger ridges, and the stability term, while the best one is
    unstable or lost from the states that past windows give."""
    rng = np.random.default_rng(context.seed)
    count = method.starts if structure.starts_vary else 1
    starts = starts_of(structure, found, records, count, scaling, rng)
    samples = of_records(records, with_elements(structure, found).x0)
    log, time = context.log, context.sampling_time
    term = stability_term(found, structure.integrators, records)
    may_be_unstable = term is None
    tried: list[tuple[bool, JudgedFit]] = []
    for stiffer in _STIFFER:
        ridge = {name: stiffer * value for name, value in options.ridge.items()}
        ridge["x0"] = found.error / sum(len(r) for r in records)
        fits, whole, held = list[StateFit](), starts, term if tried else None
        if options.pieces:
            before = fit_segments(
                structure, found.system, starts, records, samples.x0, ridge, method, log, time
            )
            begin, x0 = [one.params for one in before], [one.x0 for one in before]
            fits = fit_states(structure, starts, samples, ridge, method, log, time, begin, x0, held)
            # One start begins with whole records, since segments may mislead too.
            whole = starts[:1]
        fits += fit_states(structure, whole, samples, ridge, method, log, time, stability=held)
        ended = (judge_fit(structure, one, records, context, options.past_fit) for one in fits)
        best = min(ended, key=lambda one: one.error)
        unstable = not (may_be_unstable or is_stable(structure, best.params))
        tried.append((unstable, best))
        if best.error <= _LOST and not unstable:
            break
    return min(tried, key=lambda one: (one[0], one[1].error))[1]


def judge_fit(
    structure: StateSpaceStructure,
    fit: StateFit,
    records: ScaledData,
    context: Context,
    with_past_fit: bool,
) -> JudgedFit:
    """Add the map to the initial state to a fit, and simulate from there. The initial states of the
    fit are free: from any other a state that hardly decays may be far off."""
    if with_past_fit and window_samples(context):
        encoder, past_fit = encoder_with_past_fit(structure, fit, records, context)
    else:
        encoder, past_fit = state_encoder(structure, fit, records, context), None
    error = past_window_error(structure, fit.params, encoder, past_fit, records, context)
    return JudgedFit(fit.params, encoder, past_fit, fit.cost, error)


def error_on_segments(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    scaling: Scaling,
    context: Context,
    method: LevenbergMarquardt,
    options: LmOptions,
) -> float:
    """Mean squared error and ridge of a fit from one start to the first lengths of segments."""
    rng = np.random.default_rng(context.seed)
    starts = starts_of(structure, found, records, 1, scaling, rng)
    x0, log = with_elements(structure, found).x0, context.log
    each = structure, found.system, starts, records, x0, options.ridge, method, log
    return fit_segments(*each, context.sampling_time, _COMPARED)[0].cost


def stability_term(found: LinearFit, integrators: int, records: ScaledData) -> StabilityTerm | None:
    """Stability term of a fit of the records that begins with a linear model."""
    free = found.system.order - integrators
    samples = sum(len(record) for record in records)
    return StabilityTerm.of(found.system.a[:free, :free], samples, found.error)


def past_window_error(
    structure: StateSpaceStructure,
    params: dict[str, Any],
    encoder: Encoder,
    past_fit: PastFit | None,
    records: ScaledData,
    context: Context,
) -> float:
    """Mean squared error in z-scores of simulations of whole records from the state that their
    first past windows give."""
    errors, begin = list[Array](), past_length(context)
    for record in records:
        if len(record) > begin:
            x = encoder(past_windows_before(record, np.array([begin]), context))
            if past_fit is not None:
                rows = slice(begin - past_fit.samples, begin)
                known = record.u[None, rows.start : begin + 1]
                x = fitted_state(structure, params, past_fit, x, known, record.y[None, rows])
            with np.errstate(all="ignore"):
                y = structure.simulate(params, x, record.u[None, begin:])[1][0]
                errors.append(((y - record.y[begin:]) ** 2)[record.counts[begin:] > 0])
    found = float(np.concatenate(errors).mean()) if errors else 0.0
    return found if np.isfinite(found) else np.inf
