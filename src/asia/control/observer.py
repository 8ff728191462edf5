"""Recursive estimation of states and parameters of a lowered model, with a test of its validity.

An observer runs on one state vector: the states of the model, physical parameters, gains and
offsets of signals, and a slow disturbance of each output. It is an extended Kalman filter with
exact derivatives, or an unscented one. Page's test sums the normalised innovations squared (NIS).
Sources: Simon, Optimal State Estimation, chapters 13 and 14; Ljung, System Identification, 2nd
ed., section 11.2 (forgetting); Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation, section 5.4 (NIS); Page, Biometrika 41, 1954; Hawkins and Olwell,
Cumulative Sum Charts, chapter 6 (tails of the excursions).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from asia._progress import tracked
from asia.data.segment import Segment
from asia.data.trajectory import Array
from asia.lowering.derivatives import jacobian
from asia.lowering.evaluation import evaluate
from asia.lowering.program import Builder, LoweredModel, Program, inlined

Method: TypeAlias = Literal["ekf", "ukf"]
# Increase of the variance of the innovations that Page's test is tuned to.
INCREASE = 1.5
# Samples of simulated tests that give a threshold, and excursions whose mean excess extends it.
_CHAINS, _STEPS, _EXCURSIONS = 400, 10_000, 1_000
# Held-out samples for the noise, and for the threshold.
_NOISE_SAMPLES, _SAMPLES = 1_500, 4_000
# Past windows of a segment that show how well a model starts.
_STARTS = 30
# Rounds of the search for the noise, and trials of one.
_ROUNDS, _TRIALS = 6, 40
# Bounds of the noise in units of the residuals' variance.
_SMALL = 1e-8


@dataclass(frozen=True)
class TimeVarying:
    """Parameter that an observer estimates."""

    name: str
    """Name of a physical parameter, or `gain(SIGNAL)`, `offset(SIGNAL)`."""
    nominal: float
    """Value in the model of the run."""
    spread: float
    """Standard deviation before the first sample, and the largest that forgetting allows."""
    low: float = -math.inf
    high: float = math.inf
    floor: float = 0.0
    """Standard deviation of its estimates on held-out records, where it does not change."""


@dataclass(frozen=True)
class Noise:
    """Noise of a model, as variances."""

    output: Array
    """White noise (ny,) of the measured outputs."""
    disturbance: Array
    """Slow disturbance (ny,) of the outputs, first-order autoregressive."""
    pole: float
    """Its coefficient: correlation from sample to sample."""
    input: Array
    """White noise (nu,) that acts like the inputs."""

    def scaled(self, factor: float) -> Noise:
        """All variances times a factor."""
        output, disturbance = self.output * factor, self.disturbance * factor
        return Noise(output, disturbance, self.pole, self.input * factor)


@dataclass(frozen=True)
class Observer:
    """Everything that an observer needs, beside its memory."""

    low: LoweredModel
    """Model of one state vector (n,): see `augmented`."""
    parameters: tuple[TimeVarying, ...]
    """Parameters, whose values are the states before the last ny."""
    noise: Noise
    """That of the model without parameters."""
    initial: Array
    """Variances of the states of the model before the first sample, without parameters."""
    forgetting: float
    """Factor of the memory of parameters in one sample; 1 keeps all."""
    threshold: float
    """Page's test reports above it."""
    deviations: float
    """Standard deviations from its nominal value at which a parameter counts as changed."""

    @property
    def order(self) -> int:
        """Length of the state vector."""
        return self.low.states[0][0]

    @property
    def first(self) -> int:
        """Place of the first parameter in the state vector."""
        return self.order - self.low.ny - len(self.parameters)

    @cached_property
    def output(self) -> Program:
        """State vector and input -> output (ny,) and its derivatives (ny, n)."""
        return jacobian(self.low.output, [0])

    @cached_property
    def update(self) -> Program:
        """State vector and input -> state vector (n,) at the next sample, and its derivatives (n, n
        + nu)."""
        return jacobian(self.low.update)

    @property
    def start(self) -> Array:
        """Variances (n,) of the first state vector."""
        spreads = [one.spread**2 for one in self.parameters]
        return np.concatenate([self.initial, spreads, self.noise.disturbance])

    @property
    def drive(self) -> Array:
        """Variances (n,) that a sample adds to the state vector."""
        found = np.zeros(self.order)
        found[self.order - self.low.ny :] = self.noise.disturbance * (1.0 - self.noise.pole**2)
        return found


def augmented(
    low: LoweredModel, changes: Sequence[tuple[str, bool, int]], pole: float
) -> LoweredModel:
    """The model over one state vector: its states, of which the last may be physical parameters,
    then one number for each of the changes, then a disturbance of each output.

    Args:
        changes: `gain` or `offset`, whether it is that of an input, and its channel
        pole: coefficient of the disturbance
    """
    sizes = [math.prod(shape) for shape in low.states]
    own, added = sum(sizes), len(changes)
    n = own + added + low.ny
    nominal = np.array([1.0 if kind == "gain" else 0.0 for kind, _, _ in changes])

    def joined(build: Builder, parts: Sequence[int]) -> int:
        flat = [build.add("reshape", (p,), (math.prod(build.shape(p)),)) for p in parts]
        return build.add("concat", flat, (0,))

    initial = Builder(low.initial.inputs)
    states = inlined(initial, low.initial, [0, 1, 2])
    more = initial.constant(np.concatenate([nominal, np.zeros(low.ny)]))
    start = initial.program([joined(initial, [*states, more])])

    step = Builder(((n,), (low.nu,)))

    def cut(first: int, stop: int) -> int:
        return step.add("slice", (0,), (first, stop, 1))

    def changed(value: int, is_input: bool) -> int:
        """A signal with its gains and offsets."""
        size = step.shape(value)[0]
        for kind, op in (("gain", "mul"), ("offset", "add")):
            rows = [(k, c) for k, (what, side, c) in enumerate(changes)
                    if what == kind and side == is_input]  # fmt: skip
            if rows:
                chosen = np.zeros((size, added))
                for k, channel in rows:
                    chosen[channel, k] = 1.0
                fixed = np.where(chosen.any(axis=1), 0.0, 1.0 if kind == "gain" else 0.0)
                column = step.add("reshape", (cut(own, own + added),), (added, 1))
                factor = step.add("matmul", (step.constant(chosen), column))
                factor = step.add("reshape", (factor,), (size,))
                factor = step.add("add", (factor, step.constant(fixed)))
                value = step.add(op, (value, factor))
        return value

    ends = np.cumsum([0, *sizes]).tolist()
    parts = [
        step.add("reshape", (cut(first, stop),), shape)
        for first, stop, shape in zip(ends, ends[1:], low.states, strict=False)
    ]
    y, *after = inlined(step, low.step, [*parts, changed(1, True)])
    slow = cut(own + added, n)
    y = step.add("add", (changed(y, False), slow))
    kept = [cut(own, own + added)] if added else []
    slow = step.add("mul", (slow, step.constant(pole)))
    flat = joined(step, [*after, *kept, slow])
    return LoweredModel(
        low.n_past_u, low.n_past_y, low.nu, low.ny, low.single, start, step.program([y, flat])
    )  # fmt: skip


@dataclass(frozen=True)
class MonitorSample:
    """Result of one sample."""

    y_hat: Array
    """Output (ny,) expected before its measurement."""
    nis: float
    """Normalised innovation squared: about as large as the number of measured outputs."""
    measured: int
    """Number of measured outputs."""
    statistic: float
    """Page's statistic; above the threshold the model is not valid."""
    parameters: Array
    """Estimates (p,)."""
    deviations: Array
    """Their standard deviations (p,)."""
    since: int | None
    """Sample since which the model is not valid any more; None while it is."""

    @property
    def valid(self) -> bool:
        """Whether the model still describes the system."""
        return self.since is None


class Filter:
    """An observer on one record, sample by sample."""

    def __init__(self, observer: Observer, method: Method = "ekf") -> None:
        self.observer, self.method = observer, method

    def start(self, past_u: Array, past_y: Array, u: Array) -> None:
        """Start from the past window and the first input (nu,)."""
        self.z = evaluate(self.observer.low.initial, [past_u, past_y, u])[0]
        self.p = np.diag(self.observer.start)
        self.statistic, self._zero, self._samples = 0.0, 0, 0
        self._since: int | None = None

    def update(self, u: Array, y: Array) -> MonitorSample:
        """Take the input (nu,) and the output (ny,) of a sample; nan where it is not measured."""
        with np.errstate(all="ignore"):
            return self._updated(u, y)

    def _updated(self, u: Array, y: Array) -> MonitorSample:
        observer, known = self.observer, np.flatnonzero(np.isfinite(y))
        y_hat, cross, spread = self._expected(u)
        error, cross = (y - y_hat)[known], cross[:, known]
        spread = (spread + np.diag(observer.noise.output))[np.ix_(known, known)]
        nis = 0.0
        if len(known):
            gain = np.linalg.solve(spread, cross.T).T
            nis = float(error @ np.linalg.solve(spread, error))
            z, p = self.z + gain @ error, self.p - gain @ spread @ gain.T
            if np.isfinite(z).all() and np.isfinite(p).all():
                self.z, self.p = z, 0.5 * (p + p.T)
            else:
                nis = math.inf
        self._bound_parameters()
        first, count = observer.first, len(observer.parameters)
        estimates = self.z[first : first + count].copy()
        deviations = np.sqrt(np.maximum(np.diag(self.p)[first : first + count], 0.0))
        since = self._tested(nis, len(known), estimates, deviations)
        self._move(u)
        self._samples += 1
        return MonitorSample(
            y_hat, nis, len(known), self.statistic, estimates, deviations, since
        )  # fmt: skip

    def _expected(self, u: Array) -> tuple[Array, Array, Array]:
        """Expected output (ny,), covariance of state and output (n, ny), and of the output."""
        if self.method == "ekf":
            y_hat, slope = evaluate(self.observer.output, [self.z, u])
            cross = self.p @ slope.T
            return y_hat, cross, slope @ cross
        points = self._points(self.z, self.p)
        outputs = np.stack([evaluate(self.observer.low.output, [z, u])[0] for z in points])
        y_hat = outputs.mean(axis=0)
        apart = (outputs - y_hat) / math.sqrt(len(points))
        return y_hat, (points - self.z).T @ apart / math.sqrt(len(points)), apart.T @ apart

    def _points(self, mean: Array, covariance: Array) -> Array:
        """Points of the mean and the covariance, equally weighted (unscented, kappa 0)."""
        sizes, ways = np.linalg.eigh(covariance)
        root = ways * np.sqrt(np.maximum(sizes, 0.0) * len(mean))
        return np.concatenate([mean + root.T, mean - root.T])

    def _bound_parameters(self) -> None:
        """Keep the parameters inside their ranges, and forget."""
        for k, one in enumerate(self.observer.parameters, self.observer.first):
            self.z[k] = min(max(self.z[k], one.low), one.high)
            self._widen(k, one, 1.0 / math.sqrt(self.observer.forgetting))

    def _widen(self, k: int, one: TimeVarying, limit: float) -> None:
        """Multiply the standard deviation of a parameter, at most to its first value."""
        room = one.spread / math.sqrt(max(float(self.p[k, k]), 1e-300))
        factor = min(limit, max(room, 1.0))
        self.p[k] *= factor
        self.p[:, k] *= factor

    def _tested(self, nis: float, count: int, estimates: Array, deviations: Array) -> int | None:
        """Sample since which the model is not valid, by Page's test or by a parameter."""
        observer, before = self.observer, self.statistic
        gained = 2.0 * observer.threshold
        if math.isfinite(nis):
            gained = float(increments(np.array(nis), count))
        self.statistic = min(max(self.statistic + gained, 0.0), 2.0 * observer.threshold)
        if self.statistic == 0.0:
            self._zero = self._samples + 1
        changed = any(
            abs(value - one.nominal) > observer.deviations * math.hypot(deviation, one.floor)
            for one, value, deviation in zip(
                observer.parameters, estimates.tolist(), deviations.tolist(), strict=True
            )
        )
        if before <= observer.threshold < self.statistic:
            # The parameters are sought anew.
            for k, one in enumerate(observer.parameters, observer.first):
                self._widen(k, one, math.inf)
        if self.statistic > observer.threshold:
            self._since = min(self._zero, self._samples if self._since is None else self._since)
        elif changed:
            self._since = self._samples if self._since is None else self._since
        elif self.statistic == 0.0:
            self._since = None
        return self._since

    def _move(self, u: Array) -> None:
        """To the next sample."""
        observer, n = self.observer, self.observer.order
        if self.method == "ekf":
            z, slope = evaluate(observer.update, [self.z, u])
            f, g = slope[:, :n], slope[:, n:]
            p = f @ self.p @ f.T + (g * observer.noise.input) @ g.T
        else:
            both = np.zeros((n + len(u), n + len(u)))
            both[:n, :n], both[n:, n:] = self.p, np.diag(observer.noise.input)
            points = self._points(np.concatenate([self.z, u]), both)
            after = np.stack([evaluate(observer.low.update, [w[:n], w[n:]])[0] for w in points])
            z = after.mean(axis=0)
            p = (after - z).T @ (after - z) / len(points)
        p = p + np.diag(observer.drive)
        if np.isfinite(z).all() and np.isfinite(p).all():
            self.z, self.p = z, 0.5 * (p + p.T)


# Page's test.


def increments(nis: Array, count: int) -> Array:
    """Increment of Page's statistic by a sample: the logarithm of the likelihood ratio for
    innovations whose variance is larger by `INCREASE`."""
    return 0.5 * (1.0 - 1.0 / INCREASE) * nis - 0.5 * count * math.log(INCREASE)


def alarm_threshold(nis: Sequence[Array], count: int, rate: float, seed: int = 0) -> float:
    """Threshold of Page's test with at most so many false alarms a sample.

    It is the larger one of two: for white Gaussian innovations, and for blocks of the NIS of
    held-out records, drawn again and again. Both come from simulated tests, whose excursions have
    an exponential tail.

    Args:
        nis: normalised innovations squared (T,) of held-out records, with a mean of `count`
        count: number of outputs
        rate: false alarms a sample
    """
    rng = np.random.default_rng(seed)
    drawn = [rng.chisquare(count, (_CHAINS, _STEPS))]
    long = [one for one in nis if len(one) >= 40]
    if long:
        size = max(min(min(len(one) for one in long) // 4, 50), 10)
        starts = np.concatenate([
            first + np.arange(len(one) - size + 1)
            for one, first in zip(long, np.cumsum([0, *map(len, long)]), strict=False)
        ])  # fmt: skip
        chosen = rng.choice(starts, (_CHAINS, _STEPS // size))
        places = (chosen[..., None] + np.arange(size)).reshape(_CHAINS, -1)
        drawn.append(np.concatenate(long)[places])
    # The variance of the innovations is known with this relative error.
    known = sum(map(len, nis)) * count
    wider = 1.0 + math.sqrt(2.0 / known) if known else 1.0
    found: list[float] = []
    for one in tracked(drawn, "draw"):
        total = np.cumsum(increments(wider * one, count), axis=1)
        statistic = total - np.minimum.accumulate(np.minimum(total, 0.0), axis=1)
        statistic[:, 0] = 0.0
        flat = statistic.reshape(-1)
        peaks = np.sort(np.maximum.reduceat(flat, np.flatnonzero(flat == 0.0)))[::-1]
        alarms = rate * one.size
        most = int(min(max(_EXCURSIONS, 2.0 * alarms), len(peaks) - 1))
        excess = float(np.mean(peaks[:most]) - peaks[most])
        found.append(float(peaks[most]) + excess * math.log(most / alarms))
    return max(max(found), 1e-6)


# Noise from the residuals of a run.


@dataclass(frozen=True)
class Linearised:
    """A model along its simulation of a held-out segment."""

    residuals: Array
    """Measured minus simulated outputs (T, ny); nan where not measured."""
    states: Array
    """(T, n)."""
    a: Array
    """Derivatives (T, n, n) of the next state by the state."""
    b: Array
    """(T, n, nu), by the input."""
    c: Array
    """(T, ny, n), of the output by the state."""
    initial: Array
    """Variances (n,) of the initial states."""

    @classmethod
    def of(cls, low: LoweredModel, segment: Segment) -> Linearised:
        """Simulate a segment with a model of one state vector."""
        past_u, past_y, u, y = segment.past_u, segment.past_y, segment.u, segment.y
        output, update = jacobian(low.output, [0]), jacobian(low.update)
        (z,) = evaluate(low.initial, [past_u, past_y, u[0]])
        n, found = len(z), list[tuple[Array, ...]]()
        for row, measured in zip(u, y, strict=True):
            y_hat, c = evaluate(output, [z, row])
            after, slope = evaluate(update, [z, row])
            found.append((measured - y_hat, z, slope[:, :n], slope[:, n:], c))
            z = after
        residuals, states, a, b, c = (np.stack(part) for part in zip(*found, strict=True))
        return cls(residuals, states, a, b, c, start_variance(low, [segment], [states]))

    def likelihood(self, trials: Sequence[Noise]) -> Array:
        """Negative logarithms of the likelihood of the residuals under each of several noises."""
        n, ny, count = self.states.shape[1], self.residuals.shape[1], len(trials)
        eye = np.eye(n + ny)
        initial = np.stack([np.r_[self.initial, one.disturbance] for one in trials])
        slow = np.stack([one.disturbance * (1.0 - one.pole**2) for one in trials])
        drive = np.concatenate([np.zeros((count, n)), slow], axis=1)[:, None] * eye
        white = np.stack([one.output for one in trials])
        inputs = np.stack([one.input for one in trials])[:, None]
        z, p, total = np.zeros((count, n + ny)), initial[:, None] * eye, np.zeros(count)
        a = np.array([one.pole for one in trials])[:, None, None] * eye
        b, c = np.zeros((n + ny, self.b.shape[2])), np.eye(ny, n + ny, n)
        for k, row in enumerate(self.residuals):
            known = np.isfinite(row)
            a[:, :n, :n], b[:n], c[:, :n] = self.a[k], self.b[k], self.c[k]
            if known.any():
                h = c[known]
                cross = p @ h.T
                spread = h @ cross + white[:, known, None] * np.eye(len(h))
                error = (row[known] - z @ h.T)[..., None]
                side = np.concatenate([cross.swapaxes(1, 2), error], axis=2)
                gain = np.linalg.solve(spread, side)
                total += np.linalg.slogdet(spread)[1]
                total += (error * gain[..., -1:]).sum(axis=(1, 2))
                z = z + (cross @ gain[..., -1:])[..., 0]
                p = p - cross @ gain[..., :-1]
            z = (a @ z[..., None])[..., 0]
            p = a @ p @ a.swapaxes(1, 2) + (b * inputs) @ b.T + drive
        return np.where(np.isfinite(total), total, np.inf)


def simulated_states(low: LoweredModel, segment: Segment) -> Array:
    """States (T, n) of a simulation of a segment with a model of one state vector."""
    (z,) = evaluate(low.initial, [segment.past_u, segment.past_y, segment.u[0]])
    found: list[Array] = []
    for row in segment.u:
        found.append(z)
        (z,) = evaluate(low.update, [z, row])
    return np.stack(found)


def start_variance(
    low: LoweredModel, segments: Sequence[Segment], states: Sequence[Array]
) -> Array:
    """Variances (n,) of initial states from past windows inside the segments, around the states (T,
    n) of the simulation there."""
    found: list[Array] = []
    for one, simulated in zip(segments, states, strict=True):
        us, ys = np.concatenate([one.past_u, one.u]), np.concatenate([one.past_y, one.y])
        past_u, past_y, last = len(one.past_u), len(one.past_y), len(one.u) - 1
        # In the first half the simulation forgets its own start.
        for k in sorted(set(np.linspace(last // 2, last, _STARTS).astype(int).tolist())):
            window = us[k : past_u + k], ys[k : past_y + k]
            if np.isfinite(window[1]).all():
                found.append(evaluate(low.initial, [*window, one.u[k]])[0] - simulated[k])
    return np.mean(np.square(found), axis=0) if found else np.zeros(low.states[0])


def fit_noise(segments: Sequence[Linearised], input_variance: Array) -> Noise:
    """Noise of largest likelihood for the residuals of held-out segments.

    The measurement noise and the disturbance of an output are shares of its residual variance, and
    the noise of an input is a share of its variance, the same for all outputs and inputs.

    Args:
        input_variance: (nu,), of the training records
    """
    residuals = np.concatenate([one.residuals for one in segments])
    variance = np.nanmean(residuals**2, axis=0)
    variance = np.maximum(variance, 1e-30 * max(float(variance.max()), 1e-270))

    def noise(theta: Array) -> Noise:
        white, slow, pole, driven = np.clip(theta, -18.0, 18.0)
        return Noise(
            variance * (math.exp(white) + _SMALL), variance * math.exp(slow),
            1.0 / (1.0 + math.exp(-pole)), input_variance * math.exp(driven),
        )  # fmt: skip

    # Correlation of the residuals one and two samples apart.
    apart = [
        float(np.nanmean([np.nanmean(r[k:] * r[: len(r) - k] / variance)
                          for r in (one.residuals for one in segments)]))
        for k in (1, 2)
    ]  # fmt: skip
    pole = min(max(apart[1] / apart[0] if apart[0] > 0.05 else 0.1, 0.05), 0.999)
    slow = min(max(apart[0] / pole, 0.01), 0.95)
    best = np.array([math.log(1.0 - slow), math.log(slow), math.log(pole / (1.0 - pole)), -9.0])
    # Random search that narrows around the best, all trials of a round at once.
    rng, width = np.random.default_rng(0), np.array([1.0, 2.0, 1.5, 4.0])
    for _ in tracked(range(_ROUNDS), "round"):
        trials = best + width * np.vstack([np.zeros(4), rng.normal(size=(_TRIALS - 1, 4))])
        noises = [noise(theta) for theta in trials]
        with np.errstate(all="ignore"):
            cost = sum(one.likelihood(noises) for one in segments) + 1e-3 * (trials**2).sum(axis=1)
        best, width = trials[int(np.argmin(cost))], 0.6 * width
    return noise(best)


def make_observer(
    own: LoweredModel,
    held_out: Sequence[tuple[LoweredModel, Segment]],
    input_variance: Array,
    parameters: Sequence[TimeVarying],
    changes: Sequence[tuple[str, bool, int]],
    forgetting: float,
    rate: float,
) -> tuple[Observer, float]:
    """Observer of a model, with noise and thresholds by the innovations of fold models on held-out
    segments.

    Args:
        own: the model; its last state holds the physical parameters, if there are any
        held_out: models of the folds, of the same structure, each with a segment that it did not
            see
        input_variance: (nu,), of the training records
        parameters: physical ones, then those of `changes`
        changes: as in `augmented`
        rate: false alarms a sample

    Returns:
        the observer, and the share of the held-out NIS inside their 95 % band
    """
    from scipy.special import chdtri, ndtri

    ny = own.ny
    # The models of the folds may have other orders than the model itself.
    part, physical = _limited(held_out, _NOISE_SAMPLES), len(parameters) - len(changes)
    linearised = [Linearised.of(augmented(low, (), 0.0), one) for low, one in part]
    noise = fit_noise(linearised, input_variance)

    def initial(variances: Array) -> Array:
        return variances[: len(variances) - ny - physical]

    alone = augmented(own, (), 0.0)
    segments = [one for _, one in part]
    states = [simulated_states(alone, one) for one in segments]
    own_start = initial(start_variance(alone, segments, states))
    low = augmented(own, changes, noise.pole)
    observer = Observer(low, tuple(parameters), noise, own_start, forgetting, math.inf, math.inf)
    sequences: list[Array] = []
    apart: list[Array] = []
    for (model, one), known in zip(_limited(held_out, _SAMPLES), linearised, strict=True):
        # The parameters of the fold model are nominal for it.
        low = augmented(model, changes, noise.pole)
        fold = Filter(replace(observer, low=low, initial=initial(known.initial)))
        fold.start(one.past_u, one.past_y, one.u[0])
        nominal = fold.z[fold.observer.first : fold.observer.order - ny].copy()
        found = [fold.update(*pair) for pair in zip(one.u, one.y, strict=True)]
        settled = min(max(20, observer.order), len(found) // 2)
        full = [s.nis for s in found[settled:] if s.measured == ny and math.isfinite(s.nis)]
        sequences.append(np.array(full))
        half = found[len(found) // 2 :]
        squares = [(s.parameters - nominal) ** 2 - s.deviations**2 for s in half]
        apart.append(np.mean(squares, axis=0))
    together = np.concatenate(sequences)
    factor = max(float(together.mean()) / ny, 1e-12) if len(together) else 1.0
    together = together / factor
    low_end, high_end = (float(chdtri(ny, p)) for p in (0.975, 0.025))
    inside = float(np.mean((together > low_end) & (together < high_end)))
    floors = np.sqrt(np.maximum(np.mean(apart, axis=0), 0.0))
    return replace(
        observer,
        noise=noise.scaled(factor),
        initial=own_start * factor,
        parameters=tuple(
            replace(p, floor=float(floor)) for p, floor in zip(parameters, floors, strict=True)
        ),
        threshold=alarm_threshold([one / factor for one in sequences], ny, rate),
        deviations=float(-ndtri(0.5 * rate / max(len(parameters), 1))),
    ), inside


def _limited(
    held_out: Sequence[tuple[LoweredModel, Segment]], most: int
) -> list[tuple[LoweredModel, Segment]]:
    """The segments with about so many samples together, each shortened alike."""
    share = min(1.0, most / sum(len(one.u) for _, one in held_out))
    rows = [max(int(share * len(one.u)), min(len(one.u), 60)) for _, one in held_out]
    return [
        (low, replace(one, u=one.u[:n], y=one.y[:n]))
        for (low, one), n in zip(held_out, rows, strict=True)
    ]
