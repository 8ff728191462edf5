"""Trained neural state-space models: initial state, simulation, starts, map from past windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from asia.candidate import Context
from asia.data.relations import Transport, find_transport
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models._arrays import AnyArray, bounded, namespace, scan
from asia.models._least_squares import (
    DampingSchedule,
    LevenbergMarquardt,
    NormalEquations,
    minimise,
    traced_minimum,
)
from asia.models._linear.fit import LinearFit, Refinement, refine
from asia.models._linear.system import LinearSystem
from asia.models._networks.network import outputs_of
from asia.models._networks.structure import Cell, cast_tree
from asia.models._numerics.encoder import Encoder, affine, fit_encoder
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.symmetry import SignalTransformations
from asia.models._numerics.training_records import (
    ScaledData,
    delayed,
    flat_past,
    past_length,
    past_windows,
    window_rows,
    window_size,
)
from asia.models._state_space.structure import StateSpaceStructure
from asia.models._steps import first_of_line, through_line
from asia.models.methods import Adam

if TYPE_CHECKING:
    from asia.models._state_space.fit import StateFit

ENCODER_UNITS = 30
"""Units of the tanh layer of the map from the past window to the initial state."""
LINEAR_RIDGE = 1e-7
"""Weight, against the mean squared error in z-scores, of the squared distance of the linear system
from its start."""

# Fit of the initial state of a state-space model to the past window.
#
# The map from past windows to states errs by more than the sensor, and where small differences
# grow that error dominates the simulation. So the state at the first sample of the window is taken
# from the map, and moved until the model simulates the window: the state of greatest posterior
# probability, by Gauss-Newton steps, with the errors of map and model on the training records as
# deviations.

_DIFFERENCE = 1e-5
# Least deviations, of a state relative to its spread and of an output in z-scores.
_LEAST_STATE, _LEAST_OUTPUT = 1e-3, 1e-4
_METHOD = LevenbergMarquardt(iterations=8, damping=1e-3, tolerance=0.0)
_SCHEDULE = DampingSchedule((1.0,), 0.2, 10.0, 0.0, float("inf"), retries=False)


@dataclass(frozen=True)
class PastFit:
    """Settings of the fit of a state to the past window."""

    samples: int  # Number of last samples of the window that are used
    x_deviation: Array  # Deviation (n,) of the state that the map predicts before these samples
    y_deviation: Array  # Deviation (ny,) of the model's output


def window_samples(context: Context) -> int:
    """Number of samples of the past window in which inputs and outputs are known."""
    return min(context.n_past_u, context.n_past_y)


def encoder_with_past_fit(
    structure: StateSpaceStructure, fit: StateFit, records: ScaledData, context: Context
) -> tuple[Encoder, PastFit]:
    """Map from the past window to the state before its last samples, and settings of the fit to
    them."""
    skip, back = past_length(context), window_samples(context)
    features, states, errors = list[Array](), list[Array](), list[Array]()
    for record, x0, at in zip(records, fit.x0, window_rows(records, context), strict=True):
        if len(record) > skip:
            x, y = structure.simulate(fit.params, x0[None], record.u[None])
            features.append(past_windows(record, context)[at])
            states.append(x[0, skip - back : len(record) - back][at])
            errors.append(np.where(record.counts > 0, y[0] - record.y, np.nan))
    encoder = fit_encoder(features, states, ENCODER_UNITS, context.seed)
    left = np.concatenate([encoder(f) - x for f, x in zip(features, states, strict=True)])
    spread = np.concatenate(states).std(axis=0)
    error, apart = (np.sqrt(np.nanmean(v**2, axis=0)) for v in (left, np.concatenate(errors)))
    x_deviation = np.maximum(error, np.maximum(_LEAST_STATE * spread, 1e-9))
    y_deviation = np.maximum(apart, _LEAST_OUTPUT)
    return encoder, PastFit(back, x_deviation, y_deviation)


def fitted_state(
    structure: StateSpaceStructure,
    params: Mapping[str, Any],
    past_fit: PastFit,
    guess: AnyArray,
    u: AnyArray,
    y: AnyArray,
) -> AnyArray:
    """Fit the state of each window separately; NumPy or JAX.

    The guess (B, n) is that of the state at the first of `past_fit.samples` samples; inputs u (B,
    samples + 1, nu) and outputs y (B, samples, ny) are z-scored. Return the state (B, n) after the
    samples.
    """
    xp, (batch, n) = namespace(guess, u, y), guess.shape
    ways = _DIFFERENCE * np.concatenate([np.zeros((1, n)), np.diag(past_fit.x_deviation)])

    def residuals(x: AnyArray) -> AnyArray:
        """Weighted residuals (B, K, samples ny + n) at states (B, K, n)."""
        points = x.shape[1]
        held, measured = xp.repeat(u[:, :-1], points, axis=0), xp.repeat(y, points, axis=0)
        found = structure.simulate(params, x.reshape(batch * points, n), held)[1]
        error = ((found - measured) / past_fit.y_deviation).reshape(batch, points, -1)
        return xp.concatenate([error, (x - guess[:, None]) / past_fit.x_deviation], axis=2)

    def cost(x: AnyArray) -> AnyArray:
        return (residuals(x) ** 2).sum(axis=2)

    def linearise(x: AnyArray) -> NormalEquations:
        found = residuals(x[:, None] + ways)
        slope = (found[:, 1:] - found[:, :1]) / (_DIFFERENCE * past_fit.x_deviation[:, None])
        slope, residual = (xp.where(xp.isfinite(a), a, 0.0) for a in (slope, found[:, 0]))
        return NormalEquations(
            (found[:, 0] ** 2).sum(axis=1),
            slope @ slope.swapaxes(1, 2) + 1e-12 * np.eye(n),
            (slope @ residual[:, :, None])[:, :, 0],
        )

    with np.errstate(all="ignore"):
        if xp is np:
            x = minimise(cost, linearise, guess, _METHOD, _SCHEDULE).theta
        else:
            x = traced_minimum(cost, linearise, guess, _METHOD, _SCHEDULE)
        return structure.simulate(params, x, u)[0][:, -1]


# Fitted neural state-space model, and its simulation.


@dataclass(frozen=True)
class FittedStateSpace:
    """Result of training a neural state-space model."""

    structure: StateSpaceStructure  # Equations of the model
    params: dict[str, Any]  # Parameters as `StateSpaceStructure` reads them, in z-scores
    encoder: Encoder  # Map from the past window to the initial state
    delay: int  # Delay of the inputs, in samples
    scaling: Scaling  # Scaling from physical units to z-scores
    turns: SignalTransformations | None = None
    """Symmetries over which simulations are averaged; None: none."""
    past_fit: PastFit | None = None
    """Fit of the initial state to the past window; None where the encoder gives it."""
    transport: Transport | None = None
    """Transport of the inputs to their place of action; None: at once."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units: past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B,
        H, nu) -> (B, H, ny)."""
        if self.transport is not None:
            # Inputs at the outlet of the pipe, with the pace as an additional input.
            known, past = np.concatenate([past_u, u], axis=1), past_u.shape[1]
            leaving = np.stack([self.transport.carried(one) for one in known])
            past_u, u = leaving[:, :past], leaving[:, past:]
        if self.turns is None:
            return self._simulated(past_u, past_y, u)
        return self.turns.averaged(self._simulated, past_u, past_y, u)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """State and the inputs that the delay holds back; before them the content of the pipe,
        where there is one."""
        if self.transport is not None:
            pipe, leaving, acting = _entered(self.transport, past_u, u)
            return pipe, replace(self, transport=None).initial(leaving, past_y, acting)
        if self.turns is not None:
            return self.turns.initial(replace(self, turns=None), past_u, past_y, u)
        past, first = self.scaling.inputs(past_u), self.scaling.inputs(u)
        start = self._start(past, self.scaling.outputs(past_y), first)
        return start, first_of_line(past, first, self.delay)

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample."""
        if self.transport is not None:
            pipe, inner = state
            pipe, acting = _through(self.transport, pipe, u)
            inner, y = replace(self, transport=None).step(inner, acting)
            return (pipe, inner), y
        if self.turns is not None:
            return self.turns.step(replace(self, turns=None), state, u)
        structure, params, (x, line) = self.structure, self.params, state
        line, acting = through_line(line, self.scaling.inputs(u))
        x, w = structure.split(params, x, structure.input(params, acting))
        return (x, line), self.scaling.physical(structure.output(params, w))

    def _start(self, past: AnyArray, y: AnyArray, u: AnyArray) -> AnyArray:
        """State (B, n) at the first sample from z-scored past inputs (B, n_past_u, nu), past
        outputs y (B, n_past_y, ny) and the first input u (B, nu)."""
        x, fit = self.encoder(flat_past(past, y)), self.past_fit
        if fit is None:
            return x
        known = namespace(past, u).concatenate([past, u[:, None]], axis=1)
        rows = np.arange(past.shape[1] - fit.samples, past.shape[1] + 1) - self.delay
        held = known[:, np.maximum(rows, 0)]
        return fitted_state(self.structure, self.params, fit, x, held, y[:, -fit.samples :])

    def _simulated(self, past_u: Array, past_y: Array, u: Array) -> Array:
        past, future = self.scaling.inputs(past_u), self.scaling.inputs(u)
        start = self._start(past, self.scaling.outputs(past_y), future[:, 0])
        inputs, cell = delayed(past, future, self.delay), _StartedCell(self.structure)
        return self.scaling.physical(outputs_of(cell, self.params, start, inputs))


@dataclass(frozen=True)
class StateCell:
    """Cell of the model for Adam and for simulation: see `asia.models._networks.structure.Cell`."""

    structure: StateSpaceStructure  # Equations of the model

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
        del params
        return window


def carried_records(
    records: Sequence[Trajectory], context: Context, pace: int
) -> tuple[Transport, list[Trajectory], Context]:
    """Estimate the pipe from records; return it, the records at its outlet, and their context.
    Raises UserError if input `pace` has values that are not positive."""
    try:
        transport = find_transport(records, pace)
    except ValueError as error:
        raise UserError(f"neural_ss.Config: {error}; set transport to None") from error
    name = context.inputs[pace]
    inputs = (*context.inputs, Signal(f"{name.name}, not carried", name.unit))
    behind = [replace(r, u=transport.carried(r.u)) for r in records]
    return transport, behind, replace(context, inputs=inputs)


def _entered(transport: Transport, past_u: AnyArray, u: AnyArray) -> tuple[Any, AnyArray, AnyArray]:
    """Fill the pipe from the past window.

    The pipe holds the inputs of the samples in which its content entered (B, length, nu), the
    oldest first, and the amounts (B, length) that have passed since these began. Return it at the
    first sample, its outlet during the past window (B, n_past_u, nu + 1), and that at the first
    sample.
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


# Fit of a neural state-space model by Adam, with its map from past windows to states.


def encoded(params: dict[str, Any], start: Encoder, context: Context) -> dict[str, Any]:
    """Add an encoder that starts as `start`, with tanh functions without effect."""
    rng = np.random.default_rng(context.seed + 1)
    d, hidden = window_size(context), ENCODER_UNITS
    inner = rng.standard_normal((d, hidden)) / np.sqrt(max(d, 1))
    bend = {"inner": inner, "shift": rng.uniform(-1.0, 1.0, hidden)}
    outer = np.zeros((hidden, len(start.bias)))
    encoder = {"weights": start.weights, "bias": start.bias, **bend, "outer": outer}
    return {**params, "encoder": encoder}


def fit_by_adam(
    cell: Cell,
    params: dict[str, Any],
    records: ScaledData,
    context: Context,
    method: Adam,
    copies: int,
) -> Any:
    """Train in single precision."""
    from asia.models._networks.training import fit

    single = cast_tree(params, np.float32)
    return cast_tree(fit(cell, single, records, context, method, copies=copies), np.float64)


def fit_encoded(
    cell: Cell,
    params: dict[str, Any],
    records: ScaledData,
    context: Context,
    method: Adam,
    copies: int,
) -> tuple[dict[str, Any], Encoder]:
    """Train parameters with an encoder, which is returned separately."""
    trained = fit_by_adam(cell, params, records, context, method, copies)
    return trained, Encoder(**trained.pop("encoder"))


# Starting points of neural state-space models, which simulate as the linear model does.

# Stiffness of the elements of a start, by turns, for motions of unit size, and width of a play.
_STIFFNESS = (30.0, 2.0, 0.5)
_WIDTH = 0.5
_PARTS = (np.real, np.imag)
# Condition number of the mode shapes from which on they are not used.
_ILL_CONDITIONED = 1e8
# Least variance of a direction of the states, relative to the largest one: less is rounding.
_LEAST_VARIANCE = 1e-8
# Samples for the size of the signals that elements act on.
_SIZED = 4000


def symmetric(
    found: LinearFit, records: ScaledData, copies: int, refinement: Refinement
) -> LinearFit:
    """Refine the linear model on records and their transformations, so that it is symmetric;
    transformed records start at rest."""
    x0 = np.zeros((len(records), found.system.order))
    x0[::copies] = found.x0
    return refine(records, replace(found, x0=x0), refinement)


def in_modes(found: LinearFit, records: ScaledData, integrators: int) -> tuple[LinearFit, int]:
    """Give each mode of the linear model states of its own, of unit size on the records, before
    those that integrate.

    Returns:
        The same system in these states, and the number of complex pairs, which come first.
    """
    s, x0 = found.system, found.x0
    poles, vectors = np.linalg.eig(s.a[: s.order - integrators, : s.order - integrators])
    columns = [part(vectors[:, k]) for k in np.flatnonzero(np.imag(poles) > 0) for part in _PARTS]
    many = len(columns)
    columns += [np.real(vectors[:, k]) for k in np.flatnonzero(np.imag(poles) == 0)]
    basis = np.stack(columns, axis=1)
    if np.linalg.cond(basis) > _ILL_CONDITIONED:
        # Poles that coincide: the states as they are.
        basis, many = np.eye(len(basis)), 0
    states = _states(found, records)
    into = np.eye(s.order)
    into[: len(columns), : len(columns)] = np.linalg.inv(basis)
    sizes = np.sqrt(((states @ into.T) ** 2).mean(axis=0))
    sizes[:many] = np.repeat(np.hypot(sizes[0:many:2], sizes[1:many:2]), 2)
    sizes[len(columns) :] = 1.0
    into /= np.maximum(sizes, 1e-9)[:, None]
    return replace(found, system=s.transformed(into), x0=x0 @ into.T), many // 2


def with_unit_states(found: LinearFit, records: ScaledData, integrators: int) -> LinearFit:
    """Give the linear model uncorrelated states of unit variance on the records, those that
    integrate apart. In other coordinates a function may not see a small state, or a ridge may hold
    it."""
    s = found.system
    free = s.order - integrators
    with np.errstate(all="ignore"):
        spread = np.atleast_2d(np.cov(_states(found, records)[:, :free].T))
    into = np.eye(s.order)
    if np.isfinite(spread).all() and spread.any():
        sizes, directions = np.linalg.eigh(spread)
        least = _LEAST_VARIANCE * sizes[-1]
        into[:free, :free] = (directions / np.sqrt(np.maximum(sizes, least))).T
    return replace(found, system=s.transformed(into), x0=found.x0 @ into.T)


def _states(found: LinearFit, records: ScaledData) -> Array:
    """States of the linear model on all records, one below the other."""
    return np.concatenate([
        found.system.simulate(x0[None], r.u[None])[0][0]
        for x0, r in zip(found.x0, records, strict=True)
    ])  # fmt: skip


def with_elements(structure: StateSpaceStructure, found: LinearFit) -> LinearFit:
    """Add elements at rest to the initial states of the linear model."""
    more = structure.size - structure.order
    return replace(found, x0=np.pad(found.x0, ((0, 0), (0, more))))


def encoded_at_rest(structure: StateSpaceStructure, encoder: Encoder) -> Encoder:
    """Affine encoder of the linear model's state, with elements at rest."""
    more = structure.size - structure.order
    return affine(np.pad(encoder.weights, ((0, 0), (0, more))), np.pad(encoder.bias, (0, more)))


def starts_of(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    count: int,
    scaling: Scaling,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Make so many starting points."""
    s = found.system
    starts = [structure.start(s, rng) for _ in range(count)]
    if structure.size == structure.order:
        return starts
    u, zero = records[0].u[:_SIZED], -scaling.y_mean / scaling.y_std
    states = s.simulate(found.x0[:1, : s.order], u[None])[0][0]
    for number, start in enumerate(starts):
        if structure.friction:
            some = number * structure.friction
            start["dry"] = _friction(s, states, zero, range(some, some + structure.friction), rng)
        if structure.play:
            some = number * structure.play
            start["play"] = _play(s, states, u, range(some, some + structure.play), rng)
    return starts


def _friction(
    system: LinearSystem, states: Array, zero: Array, turns: range, rng: np.random.Generator
) -> dict[str, Any]:
    """Elements of friction without effect, one for each number in `turns`.

    The directions are the difference of the output, the output, and random ones, in turn. The
    states (T, n) of the linear system give the sizes; `zero` (ny,) is the output at rest.
    """
    n, ny, count = system.order, len(system.c), len(turns)
    difference = system.c @ (np.eye(n) - np.linalg.pinv(system.a))
    known = [*((row, 0.0) for row in difference), *zip(system.c, system.offset - zero, strict=True)]
    rows: list[tuple[Array, float]] = []
    for turn in turns:
        cycle = turn % (len(known) + 1)
        rows.append(known[cycle] if cycle < len(known) else (rng.standard_normal(n), 0.0))
    w, bias = np.stack([row for row, _ in rows], axis=1), np.array([b for _, b in rows])
    sizes = _sizes(states @ w)
    stiffness = [_STIFFNESS[k % len(_STIFFNESS)] for k in range(turns.start // count, turns.stop)]
    return {
        "w": w / sizes,
        "b": bias / sizes,
        "g": np.zeros((count, n)),
        "h": np.zeros((count, ny)),
        "stiff": np.log(stiffness[:count]),
        "uneven": np.zeros(count),
        "extra": np.zeros(count),
        "narrow": np.full(count, np.log(5.0)),
    }


def _play(
    system: LinearSystem, states: Array, u: Array, turns: range, rng: np.random.Generator
) -> dict[str, Any]:
    """Elements of play without effect, one for each number in `turns`.

    The directions are the inputs, the outputs, and random ones, in turn, and each round of them has
    half the width of the one before.
    """
    n, nu, count = system.order, u.shape[1], len(turns)
    known = [np.eye(n + nu)[n + j] for j in range(nu)]
    known += [np.concatenate([row, np.zeros(nu)]) for row in system.c]
    rows: list[Array] = []
    for turn in turns:
        cycle = turn % (len(known) + 1)
        rows.append(known[cycle] if cycle < len(known) else rng.standard_normal(n + nu))
    both = np.stack(rows, axis=1)
    width = _WIDTH * 0.5 ** (turns.start // (len(known) + 1) % 3)
    both = both / (_sizes(np.hstack([states, u]) @ both) * width)
    return {
        "w": both[:n],
        "wu": both[n:],
        "g": np.zeros((count, n)),
        "h": np.zeros((count, len(system.c))),
    }


def _sizes(values: Array) -> Array:
    """Standard deviation of each column."""
    found = values.std(axis=0)
    return np.where(found > 1e-9, found, 1.0)
