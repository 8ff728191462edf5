"""Static functions of inputs and outputs around a model of any family.

    maps = static_maps.Config(input_map="saturation")
    model = static_maps.build(maps, linear.build(linear.Config(), context))
    model = static_maps.train(linear.train, model, trajectories, context, method)

The model inside receives f(u) and simulates z; the output is y = g(z). The functions are fitted
first, to the simulation error of a linear model between them, with numerator, offset and initial
states eliminated (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973). The
family is then fitted to the mapped training records. For a sensor without sign, signs and linear
model are estimated in turn (phase retrieval: Fienup, Applied Optics 21(15), 1982).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, TypeVar

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models import linear
from asia.models._arrays import AnyArray, bounded, namespace
from asia.models._config import check_choice
from asia.models._linear.fit import LinearFit, Refinement, fit, solve_linear_part
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import window_segments
from asia.models._numerics.training_records import ScaledTrajectory, check, scaled, shortened
from asia.models._reuse import reused
from asia.models._steps import FittedModel

M = TypeVar("M")

InputMap = Literal["saturation", "dead_zone", "monotone"]
OutputMap = Literal["magnitude", "square", "monotone"]

# Samples that the functions are fitted to; segments of a problem with a horizon.
_SAMPLES, _WINDOWS = 3000, 60
# Quantiles at the knots of free functions, and limits of their slopes.
_QUANTILES = (0.02, 0.15, 0.35, 0.65, 0.85, 0.98)
_SLOPES = (0.02, 20.0)
# First guesses of the two levels: quantiles of the input on each side.
_LEVELS = (0.02, 0.08, 0.16, 0.25, 0.35)
# Alternations of functions and poles, and of signs and linear model.
_ROUNDS, _SIGN_ROUNDS, _PAST_ROUNDS = 3, 12, 6
# Low-pass filters whose signs start the search for the signs of an output: their number, and the
# greatest time constant as a share of the longest record.
_FILTERS, _SLOWEST = 6, 0.25
_MOST_ORDER = 4


@dataclass(frozen=True)
class Config:
    """Static functions around a model; None leaves the signals as they are."""

    input_map: InputMap | None = None
    """Function of every input: "saturation" with a lower and an upper level, "dead_zone" with its
    two edges, or "monotone", a rising piecewise linear function."""
    output_map: OutputMap | None = None
    """Function of every output: "magnitude", the sensor gives no sign, "square", it gives the
    square, or "monotone", a rising piecewise linear function."""

    def __post_init__(self) -> None:
        check_choice(self, "input_map", ("saturation", "dead_zone", "monotone", None))
        check_choice(self, "output_map", ("magnitude", "square", "monotone", None))


@dataclass(frozen=True)
class PiecewiseLinear:
    """Continuous piecewise linear function of each channel of a signal."""

    knots: Array
    """Rising knots (K, n), physical units."""
    slopes: Array
    """Slopes (K + 1, n): below the first knot, between the knots, above the last one."""
    first: Array
    """Values (n,) at the first knot."""

    def __call__(self, x: AnyArray) -> AnyArray:
        """Values at x (..., n)."""
        xp, k, s = namespace(x), self.knots, self.slopes
        y = self.first + s[0] * xp.minimum(x - k[0], 0.0) + s[-1] * xp.maximum(x - k[-1], 0.0)
        for (low, high), slope in zip(pairwise(k), s[1:-1], strict=True):
            y = y + slope * (bounded(x, low, high) - low)
        return y

    def inverse(self) -> PiecewiseLinear:
        """Inverse function, where all slopes are positive."""
        return PiecewiseLinear(self(self.knots), 1.0 / self.slopes, self.knots[0])


@dataclass(frozen=True)
class Signs:
    """Linear model that gives the signs of past outputs, of n = n_past_y ny samples.

    The initial state is fitted to outputs with assumed signs, which are then those of the fit, in
    turn, from several first guesses; the fit with the least error of the size counts.
    """

    response: Array
    """Response (n_past_u nu, n) of the outputs to the past inputs from rest, physical units."""
    offset: Array
    """Output (n,) for zero inputs."""
    free: Array
    """Part (n, n) of the outputs that initial states of the usual size explain."""
    guesses: Array
    """First signs (G, n), besides those of the response from rest."""

    def __call__(self, past_u: AnyArray, past_y: AnyArray) -> AnyArray:
        """Past outputs (B, n_past_y, ny) with signs."""
        xp, batch = namespace(past_u, past_y), past_y.shape[0]
        size = past_y.reshape(batch, past_y.shape[1] * past_y.shape[2])
        flat = past_u.reshape(batch, past_u.shape[1] * past_u.shape[2])
        driven = flat @ self.response + self.offset
        best = error = None
        for guess in (None, *self.guesses):
            z = driven if guess is None else guess * size
            for _ in range(_PAST_ROUNDS):
                signed = xp.where(z < 0, -size, size)
                z = driven + (signed - driven) @ self.free
            signed = xp.where(z < 0, -size, size)
            # Squared error with that of the initial state, in its usual size.
            left = ((signed - driven) * (signed - z)).sum(axis=1)[:, None]
            if best is None or error is None:
                best, error = signed, left
            else:
                # A later guess has to be better by more than rounding.
                better = left < 0.99 * error
                best, error = xp.where(better, signed, best), xp.where(better, left, error)
        return xp.zeros_like(past_y) if best is None else best.reshape(past_y.shape)


@dataclass(frozen=True)
class FittedMaps:
    """Fitted functions of the inputs and outputs."""

    config: Config
    inputs: PiecewiseLinear | None = None
    outputs: PiecewiseLinear | None = None
    """Function from the measured output to that of the model inside."""
    signs: Signs | None = None

    def driven(self, u: AnyArray) -> AnyArray:
        """Inputs of the model inside."""
        return u if self.inputs is None else self.inputs(u)

    def inside(self, past_u: AnyArray, past_y: AnyArray) -> AnyArray:
        """Past outputs of the model inside."""
        if self.outputs is not None:
            return self.outputs(past_y)
        if self.signs is None:
            return past_y
        return self.signs(self.driven(past_u), _magnitude(self.config, past_y))

    def measured(self, z: AnyArray) -> AnyArray:
        """Measured outputs for those of the model inside."""
        if self.outputs is not None:
            return self.outputs.inverse()(z)
        if self.config.output_map == "magnitude":
            return abs(z)
        return z * z if self.config.output_map == "square" else z


@dataclass(frozen=True)
class MappedModel:
    """Model of a family between static functions; before training `maps` is None."""

    config: Config
    inner: Any
    maps: FittedMaps | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units, see `asia.candidate.Model`."""
        m = self._trained()
        z = self.inner.simulate(m.driven(past_u), m.inside(past_u, past_y), m.driven(u))
        return m.measured(z)

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state of the model inside."""
        m = self._trained()
        return self.inner.initial(m.driven(past_u), m.inside(past_u, past_y), m.driven(u))

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance the model inside by one sample."""
        m = self._trained()
        state, z = self.inner.step(state, m.driven(u))
        return state, m.measured(z)

    def parameters(self) -> dict[str, float]:
        """Levels of the inputs, or slopes of the functions, then the parameters of the model
        inside."""
        m, found = self._trained(), dict[str, float]()
        if m.inputs is not None and self.config.input_map in ("saturation", "dead_zone"):
            for k, (low, high) in enumerate(m.inputs.knots.T, 1):
                found |= {f"u{k} lower level": float(low), f"u{k} upper level": float(high)}
        names = getattr(self.inner, "parameters", dict[str, float])()
        return dict([*found.items(), *names.items()][:64])

    def equations(self) -> tuple[str, ...]:
        """Equations of the model inside."""
        return getattr(self.inner, "equations", tuple[str, ...])()

    def _trained(self) -> FittedMaps:
        if self.maps is None:
            raise UserError("static maps: not trained yet; call train first")
        return self.maps


def build(config: Config, inner: object) -> MappedModel:
    """Put static functions around an untrained model of a family."""
    return MappedModel(config, inner)


def train(
    family: Callable[[Any, Sequence[Trajectory], Context, Any], FittedModel],
    model: MappedModel,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: object,
) -> MappedModel:
    """Fit the functions, then the model inside to the mapped records.

    Args:
        family: `train` of the family of the model inside.
        model: untrained model.
        trajectories: training records.
        context: context of the fit.
        method: training method of the family.

    Raises:
        UserError: for records too short or mis-shaped, and as the family does.
    """
    check(trajectories, context)
    maps, z = _signed(model.config, trajectories, context)
    config = maps.config
    if config.input_map is not None or config.output_map == "monotone":
        part = window_segments(z, context, _WINDOWS)
        time = context.sampling_time, context.n_past_u, context.n_past_y, context.horizon
        inputs, outputs = reused(
            "maps", (config, part, time),
            lambda log: _fitted(config, part, replace(context, log=log)), context.log,
        )  # fmt: skip
        maps = replace(maps, inputs=inputs, outputs=outputs)
    mapped = [
        Trajectory(
            maps.driven(r.u),
            r.y if maps.outputs is None else maps.outputs(r.y),
            r.sampling_time, r.name, r.missing, r.reference,
        )
        for r in z
    ]  # fmt: skip
    score = context.validation_score
    if score is not None:
        context = replace(
            context, validation_score=lambda inner: score(replace(model, inner=inner, maps=maps))
        )
    return replace(model, inner=family(model.inner, mapped, context, method), maps=maps)


# Fit of piecewise linear functions around a linear model.


def _functions(kind: str, x: Array, theta: Array) -> PiecewiseLinear:
    """Function of the kind: theta (P, n) has the levels in physical units, or log slopes; x (T, n)
    are the samples, whose mean gain a free function keeps."""
    n = x.shape[1]
    if kind in ("saturation", "dead_zone"):
        knots = np.sort(theta, axis=0)
        saturates = kind == "saturation"
        slopes = np.tile([[0.0], [1.0], [0.0]] if saturates else [[1.0], [0.0], [1.0]], n)
        # A dead zone gives zero at its edges, a saturation its levels.
        return PiecewiseLinear(knots, slopes, knots[0] if saturates else np.zeros(n))
    slopes, knots = np.exp(theta), np.quantile(x, _QUANTILES, axis=0)
    plain = PiecewiseLinear(knots, slopes, knots[0])
    y = plain(x)
    gain = x.std(axis=0) / np.maximum(y.std(axis=0), 1e-300)
    offset = x.mean(axis=0) - gain * y.mean(axis=0)
    return PiecewiseLinear(knots, gain * slopes, gain * knots[0] + offset)


def _fitted(
    config: Config, segments: Sequence[Trajectory], context: Context
) -> tuple[PiecewiseLinear | None, PiecewiseLinear | None]:
    """Fit the functions of the inputs, and the monotone ones of the outputs."""
    from scipy.optimize import least_squares

    bent = config.output_map == "monotone"
    scaling = Scaling.of(segments)
    u_all = np.concatenate([r.u for r in segments])
    y_all = np.concatenate([r.y for r in segments])
    plain = shortened(scaled(segments, scaling), _SAMPLES, 200)
    choice = linear.Config(max_order=_MOST_ORDER, delay=None)
    found, delay, _ = linear.fit_records(plain, context, choice, Refinement(iterations=15))
    order = max(2, found.system.order)

    nu, ny, kind = context.nu, context.ny, config.input_map
    rows = {"saturation": 2, "dead_zone": 2, "monotone": len(_QUANTILES) + 1}
    inputs = rows[kind] if kind else 0
    outputs = rows["monotone"] if bent else 0

    def functions(theta: Array) -> tuple[PiecewiseLinear | None, PiecewiseLinear | None]:
        first, second = theta[: inputs * nu], theta[inputs * nu :]
        return (
            _functions(kind, u_all, first.reshape(inputs, nu)) if kind else None,
            _functions("monotone", y_all, second.reshape(outputs, ny)) if bent else None,
        )

    def mapped(theta: Array) -> list[ScaledTrajectory]:
        f, h = functions(theta)
        found: list[ScaledTrajectory] = []
        for r in plain:
            u, y = r.u, r.y
            if f is not None:
                u = scaling.inputs(f(u * scaling.u_std + scaling.u_mean))
            if h is not None:
                y = scaling.outputs(h(scaling.physical(y)))
            found.append(replace(r, u=u, y=y, undelayed_u=u).with_delay(delay))
        return found

    def residuals(theta: Array, at: LinearFit) -> Array:
        late = mapped(theta)
        best = solve_linear_part(late, at.system.a, at.system.c)
        parts = [
            (r.weight * (r.y - best.system.simulate(x0[None], r.u[None])[1][0])).ravel()
            for r, x0 in zip(late, best.x0, strict=True)
        ]
        return np.nan_to_num(np.concatenate(parts), nan=1e3, posinf=1e3, neginf=-1e3)

    if kind in ("saturation", "dead_zone"):
        low, high = np.tile(u_all.min(axis=0), 2), np.tile(u_all.max(axis=0), 2)
        shares = _LEVELS if kind == "saturation" else tuple(0.5 - s for s in _LEVELS)
        guesses = [np.quantile(u_all, [s, 1.0 - s], axis=0).ravel() for s in shares]
    else:
        low, high = (np.full(inputs * nu, np.log(v)) for v in _SLOPES)
        guesses = [np.zeros(inputs * nu)]
    margin = 1e-9 + 1e-6 * (high - low)
    guesses = [np.clip(g, low + margin, high - margin) for g in guesses]
    ends = [np.full(outputs * ny, np.log(v)) for v in _SLOPES]
    bounds = np.concatenate([low, ends[0]]), np.concatenate([high, ends[1]])
    tried: list[tuple[float, Array, LinearFit]] = []
    for guess in guesses:
        theta = np.concatenate([guess, np.zeros(outputs * ny)])
        start = fit(mapped(theta), order, Refinement(iterations=5))
        tried.append((start.error, theta, start))
    _, theta, start = min(tried, key=lambda t: t[0])
    step = 1e-3 * (bounds[1] - bounds[0]) / np.maximum(abs(theta), 1e-9)
    for _ in range(_ROUNDS):
        theta = least_squares(
            residuals, theta, bounds=bounds, x_scale=bounds[1] - bounds[0] + 1e-12,
            diff_step=np.clip(step, 1e-6, 1.0), max_nfev=8, args=(start,),
        ).x  # fmt: skip
        start = fit(mapped(theta), order, Refinement(iterations=5))
    return functions(theta)


# Signs of outputs that a sensor without sign lost.


def _magnitude(config: Config, y: AnyArray) -> AnyArray:
    if config.output_map == "square":
        return namespace(y).sqrt(namespace(y).maximum(y, 0.0))
    return abs(y)


def _signed(
    config: Config, trajectories: Sequence[Trajectory], context: Context
) -> tuple[FittedMaps, Sequence[Trajectory]]:
    """Give signs to outputs where the sensor has none: those of the linear model that fits best."""
    if config.output_map not in ("magnitude", "square"):
        return FittedMaps(config), trajectories
    from scipy.signal import lfilter

    sizes = [_magnitude(config, r.y) for r in trajectories]
    inputs = np.concatenate([r.u for r in trajectories])
    spread = np.where(inputs.std(axis=0) > 0, inputs.std(axis=0), 1.0)
    longest = max(map(len, trajectories))
    best: tuple[float, list[Array], LinearFit, Scaling, Array] | None = None
    drives = [*np.eye(context.nu), np.ones(context.nu)][: 1 if context.nu == 1 else None]
    for weights in drives:
        for constant in np.geomspace(1.0, max(1.0, _SLOWEST * longest), _FILTERS):
            pole = np.exp(-1.0 / constant)
            signs: list[Array] = []
            for r in trajectories:
                v = (r.u - inputs.mean(axis=0)) / spread @ weights
                filtered = np.asarray(lfilter([1.0 - pole], [1.0, -pole], v))
                signs.append(np.where(filtered < 0, -1.0, 1.0)[:, None] * np.ones(context.ny))
            for _ in range(_SIGN_ROUNDS):
                records = _with_outputs(trajectories, signs, sizes)
                scaling = Scaling.of(records)
                z = scaled(records, scaling)
                found = fit(z, _MOST_ORDER, Refinement(iterations=6))
                runs = [
                    found.system.simulate(x0[None], r.u[None])
                    for r, x0 in zip(z, found.x0, strict=True)
                ]
                simulated = [scaling.physical(y[0]) for _, y in runs]
                error = sum(
                    float(((abs(s) - a) ** 2 * r.measured).sum())
                    for s, a, r in zip(simulated, sizes, trajectories, strict=True)
                )
                if np.isfinite(error) and (best is None or error < best[0]):
                    states = np.concatenate([x[0] for x, _ in runs])
                    best = error, signs, found, scaling, states
                after = [np.where(s < 0, -1.0, 1.0) for s in simulated]
                if all((a == b).all() for a, b in zip(after, signs, strict=True)):
                    break
                signs = after
    if best is None:
        raise UserError(
            "static maps: no linear model follows the size of the outputs, so their signs cannot "
            "be estimated; leave output_map out"
        )
    error, signs, found, scaling, states = best
    # Weight of the initial state: variance of the error, over that of the states.
    power = states.T @ states / len(states)
    power += 1e-6 * np.trace(power) / len(power) * np.eye(len(power))
    weight = error / len(states) / context.ny * np.linalg.inv(power)
    maps = FittedMaps(config, signs=_past_signs(found, scaling, context, weight))
    return maps, _with_outputs(trajectories, signs, sizes)


def _with_outputs(
    trajectories: Sequence[Trajectory], signs: Sequence[Array], sizes: Sequence[Array]
) -> list[Trajectory]:
    return [
        Trajectory(r.u, sign * size, r.sampling_time, r.name, r.missing, r.reference)
        for r, sign, size in zip(trajectories, signs, sizes, strict=True)
    ]


def _past_signs(found: LinearFit, scaling: Scaling, context: Context, weight: Array) -> Signs:
    """Response of past outputs to the past inputs from rest, in physical units.

    Args:
        weight: (order, order), of the squares of initial states against those of outputs
    """
    s, lags = found.system, max(context.n_past_u, context.n_past_y)
    pulses = [s.d]
    power = s.b
    for _ in range(lags - 1):
        pulses.append(s.c @ power)
        power = s.a @ power
    response = np.zeros((context.n_past_u, context.nu, context.n_past_y, context.ny))
    for i in range(context.n_past_u):
        for k in range(context.n_past_y):
            # Both windows end with the same sample.
            lag = (context.n_past_u - i) - (context.n_past_y - k)
            if lag >= 0:
                response[i, :, k] = (pulses[lag] / scaling.u_std).T * scaling.y_std
    rows = context.n_past_u * context.nu
    matrix = response.reshape(rows, context.n_past_y * context.ny)
    offset = np.tile(scaling.physical(s.offset), context.n_past_y)
    means = np.tile(scaling.u_mean, context.n_past_u)
    states, seen = np.eye(s.order), list[Array]()
    for _ in range(context.n_past_y):
        seen.append((s.c @ states) * scaling.y_std[:, None])
        states = s.a @ states
    observed = np.concatenate(seen)
    # Signs that change once, or not at all.
    ahead = np.arange(context.n_past_y)[None, :] < np.linspace(0, context.n_past_y, 5)[:, None]
    guesses = np.repeat(np.where(ahead, 1.0, -1.0), context.ny, axis=1)
    return Signs(
        matrix, offset - means @ matrix,
        observed @ np.linalg.solve(observed.T @ observed + weight, observed.T),
        np.concatenate([guesses, -guesses[1:-1]]),
    )  # fmt: skip
