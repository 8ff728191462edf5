"""Echo state network: a fixed random reservoir with a linear readout found by ridge regression.

r[k+1] = (1 - a) r[k] + a tanh(W r[k] + V u[k] + b), y[k] linear in r[k+1] and u[k]; the leaks a
of the units spread over a range of time constants. The state before the first sample is regressed
on the past window. Where the problem has a horizon, the past window sets the state through a
random layer instead and is read again by the readout, times the elapsed time too: a simulation of
few samples is mostly its start. The outputs are not fed back. Nothing is trained by gradient.
Sources: Jaeger, GMD Report 148, 2001; Lukosevicius, A practical guide to applying echo state
networks, 2012.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models._arrays import AnyArray, namespace, scan
from asia.models._config import check_at_least, demand
from asia.models._numerics.encoder import Encoder, affine, fit_encoder
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import segments
from asia.models._numerics.training_records import (
    ScaledData,
    check,
    flat_past,
    mean_square,
    past_length,
    past_windows,
    regress_outputs,
    scaled,
    window_rows,
)
from asia.models._steps import TrainableModel, mean
from asia.models.methods import LeastSquares

_MOST_SAMPLES = 40_000


@dataclass(frozen=True)
class Config:
    """Size and dynamics of the reservoirs."""

    units: int = 100
    """Units of a reservoir."""
    density: float = 0.1
    """Share of the possible connections between the units that exist."""
    radius: float = 0.9
    """Largest modulus of the eigenvalues of these connections."""
    input_scale: float = 1.0
    """Greatest input weight."""
    bias: float = 0.5
    """Greatest shift of a unit."""
    shortest: float = 1.0
    """Least time constant of a unit, in samples; they are log-spaced."""
    longest: float = 50.0
    """Greatest time constant of a unit, in samples."""
    washout: int = 50
    """Samples at the start of a record whose reservoir states are not used."""
    members: int = 8
    """Reservoirs with separate readouts, whose outputs are averaged."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "units", "members")
        check_at_least(0, self, "washout", "radius", "input_scale")
        demand(self, "density", 0 < self.density <= 1, "a share in (0, 1]")
        demand(self, "shortest", 0 < self.shortest <= self.longest, "0 < shortest <= longest")


@dataclass(frozen=True)
class Reservoir:
    """Random recurrent layer."""

    recurrent: Array
    """Weights (n, n)."""
    drive: Array
    """Input weights (nu, n)."""
    bias: Array
    """(n,)."""
    leak: Array
    """(n,), in (0, 1)."""

    def run(self, state: Array, u: Array) -> Array:
        """States (B, T, n) after each input u (B, T, nu), from state (B, n)."""
        drive = (u @ self.drive + self.bias).swapaxes(0, 1)
        return scan(self.advanced, state, drive)[1].swapaxes(0, 1)

    def advanced(self, state: AnyArray, drive: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Advance the state (B, n) by a sample with this drive (B, n), as `scan` requires."""
        tanh = namespace(state, drive).tanh
        state = state + self.leak * (tanh(state @ self.recurrent + drive) - state)
        return state, state


@dataclass(frozen=True)
class Member:
    """Reservoir with its fitted maps."""

    reservoir: Reservoir
    """Random layer."""
    start: Encoder
    """Map from the past window to the state of the reservoir."""
    readout: Encoder
    """Map from features to outputs."""
    span: int | None
    """Horizon of a problem that has one, whose readout sees the past window."""

    def __call__(self, past: Array, u: Array) -> Array:
        """Simulate past (B, d), u (B, H, nu) -> (B, H, ny), all z-scored."""
        features = _features(self.reservoir.run(self.start(past), u), u, past, self.span)
        batch, length = u.shape[:2]
        return self.readout(features.reshape(batch * length, -1)).reshape(batch, length, -1)

    def initial(self, past: AnyArray) -> tuple[AnyArray, ...]:
        """State before the first sample; with a span also the window and the samples so far."""
        x = self.start(past)
        return (x,) if self.span is None else (x, past, 0.0 * x[:, :1])

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """State after a z-scored input u (B, nu), and the output."""
        r, (x, *held) = self.reservoir, state
        x, _ = r.advanced(x, u @ r.drive + r.bias)
        seen = [x, u]
        if self.span is not None:
            past, count = held
            count = count + 1.0
            seen += [past, past * (count / np.float64(self.span))]
            held = [past, count]
        return (x, *held), self.readout(namespace(u).concatenate(seen, axis=1))


@dataclass(frozen=True)
class FittedReservoirs:
    """Result of training an echo state network."""

    members: tuple[Member, ...]
    """Reservoirs whose outputs are averaged."""
    scaling: Scaling
    """Scaling from physical units to z-scores."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units; the output is the mean over the reservoirs."""
        past = flat_past(self.scaling.inputs(past_u), self.scaling.outputs(past_y))
        inputs = self.scaling.inputs(u)
        return self.scaling.physical(np.mean([m(past, inputs) for m in self.members], axis=0))

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """State of each reservoir at the first sample."""
        del u
        past = flat_past(self.scaling.inputs(past_u), self.scaling.outputs(past_y))
        return [member.initial(past) for member in self.members]

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample."""
        v = self.scaling.inputs(u)
        pairs = [m.step(s, v) for m, s in zip(self.members, state, strict=True)]
        return [s for s, _ in pairs], self.scaling.physical(mean([y for _, y in pairs]))


@dataclass(frozen=True)
class EchoState(TrainableModel[Config, FittedReservoirs]):
    """Echo state network."""

    label = "echo state network"


build = EchoState.build


def train(
    model: EchoState, trajectories: Sequence[Trajectory], context: Context, method: LeastSquares
) -> EchoState:
    """Draw the reservoirs from `context.seed` and fit the readouts.

    `method.ridge` None chooses the ridge by the error on blocks left out.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    rng = np.random.default_rng(context.seed)
    members: list[Member] = []
    for i in range(model.config.members):
        reservoir = draw(model.config, context.nu, rng)
        if context.horizon is None:
            start, x, y, weight = _whole_records(model.config, reservoir, records, context)
        else:
            start, x, y, weight = _horizon_segments(model.config, reservoir, records, context, rng)
        readout = _readout(x, y, weight, method)
        context.log(i, float(np.sqrt(mean_square(readout(x) - y, weight))))
        members.append(Member(reservoir, start, readout, context.horizon))
    return replace(model, fitted=FittedReservoirs(tuple(members), scaling))


def draw(config: Config, nu: int, rng: np.random.Generator) -> Reservoir:
    """Draw a random reservoir."""
    n = config.units
    recurrent = rng.uniform(-1.0, 1.0, (n, n)) * (rng.random((n, n)) < config.density)
    largest = float(np.abs(np.linalg.eigvals(recurrent)).max())
    recurrent *= config.radius / largest if largest > 0 else 0.0
    drive = config.input_scale * rng.uniform(-1.0, 1.0, (nu, n))
    bias = config.bias * rng.uniform(-1.0, 1.0, n)
    constants = np.exp(rng.uniform(np.log(config.shortest), np.log(config.longest), n))
    return Reservoir(recurrent, drive, bias, 1.0 - np.exp(-1.0 / constants))


def _features(states: Array, u: Array, past: Array, span: int | None) -> Array:
    """Features (B, T, d) of the readout."""
    if span is None:
        return np.concatenate([states, u], axis=2)
    length = u.shape[1]
    held = np.repeat(past[:, None], length, axis=1)
    elapsed = np.arange(1, length + 1)[:, None] / span
    return np.concatenate([states, u, held, held * elapsed], axis=2)


def _whole_records(
    config: Config, reservoir: Reservoir, records: ScaledData, context: Context
) -> tuple[Encoder, Array, Array, Array]:
    """States of whole records from an empty reservoir; no less than a quarter of each record is
    used."""
    past = past_length(context)
    parts = list[tuple[Array, Array, Array]]()
    before: list[Array] = []
    seen: list[Array] = []
    for r, at in zip(records, window_rows(records, context), strict=True):
        states = reservoir.run(np.zeros((1, len(reservoir.leak))), r.u[None])[0]
        first = max(min(config.washout, 3 * len(r) // 4), past, 1)
        if first >= len(r):
            continue
        stride = max(1, len(r) * len(records) // _MOST_SAMPLES)
        rows = np.arange(first, len(r), stride)
        features = _features(states[None, rows], r.u[None, rows], np.empty((1, 0)), None)[0]
        parts.append((features, r.y[rows], r.counts[rows]))
        known = np.isin(rows - past, np.arange(len(r) - past)[at])
        before.append(states[rows[known] - 1])
        seen.append(past_windows(r, context)[rows[known] - past])
    x, y, weight = map(np.concatenate, zip(*parts, strict=True))
    return fit_encoder(seen, before), x, y, weight


def _horizon_segments(
    config: Config,
    reservoir: Reservoir,
    records: ScaledData,
    context: Context,
    rng: np.random.Generator,
) -> tuple[Encoder, Array, Array, Array]:
    """Segments of the problem's horizon, whose states start from a random layer."""
    data = segments(records, context, _MOST_SAMPLES)
    assert data is not None  # check() has seen a record longer than the past window
    past = flat_past(data.past_u, data.past_y)
    size, n = past.shape[1], config.units
    inner = rng.standard_normal((size, n)) / np.sqrt(max(size, 1))
    bias = config.bias * rng.uniform(-1, 1, n)
    start = Encoder(np.zeros((size, n)), np.zeros(n), inner, bias, np.eye(n))
    features = _features(reservoir.run(start(past), data.u), data.u, past, context.horizon)
    x, y, weight = (v.reshape(-1, v.shape[-1]) for v in (features, data.y, data.weight))
    return start, x, y, weight


def _readout(x: Array, y: Array, weight: Array, method: LeastSquares) -> Encoder:
    """Map from features (N, d) to outputs (N, ny), each fitted where its weight counts it."""

    def solve(x: Array, y: Array) -> Array:
        if method.ridge is None:
            one = fit_encoder([x], [y])
            return np.vstack([one.weights, one.bias])
        center, mean = x.mean(axis=0), y.mean(axis=0)
        gram = (x - center).T @ (x - center) + method.ridge * len(x) * np.eye(x.shape[1])
        weights = np.linalg.lstsq(gram, (x - center).T @ (y - mean), rcond=None)[0]
        return np.vstack([weights, mean - center @ weights])

    theta = regress_outputs(x, y, weight, solve)
    return affine(theta[:-1], theta[-1])
