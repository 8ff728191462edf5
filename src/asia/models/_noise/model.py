"""Noise model of a residual: choice, estimate, whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, get_args

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace, scan
from asia.models._config import check_choice, demand, owner
from asia.models._numerics.training_records import spread

NoiseKind: TypeAlias = Literal["white", "slow"]


def lfilter(
    b: Sequence[float] | Array, a: Sequence[float] | Array, x: Array, **options: Any
) -> Any:
    """`scipy.signal.lfilter`, which is loaded when a noise model is fitted: it takes half a second
    of every worker."""
    from scipy import signal

    return signal.lfilter(b, a, x, **options)


class NoiseSettings(Protocol):
    """Settings of a training method that concern noise."""

    @property
    def noise_model(self) -> NoiseKind:
        """Model of the residual of a simulation."""
        ...

    @property
    def huber(self) -> float | None:
        """Threshold on the innovations in their deviations; None is least squares."""
        ...


@dataclass(frozen=True)
class NoiseChoice:
    """Given and estimated parts of the noise model."""

    slow: bool
    """The noise has a slow part."""
    huber: float | None = None
    """Threshold on the innovations, in their deviations, beyond which their cost grows in
    proportion to them; None is least squares."""

    @classmethod
    def of(cls, method: NoiseSettings) -> NoiseChoice | None:
        """Take the choice from a method; None where the method is plain least squares."""
        slow = method.noise_model == "slow"
        if not slow and method.huber is None:
            return None
        return cls(slow, method.huber)


def check_noise(method: NoiseSettings) -> None:
    """Check the noise settings of a method. Raises UserError if a setting is out of its range."""
    check_choice(method, "noise_model", get_args(NoiseKind))
    huber = method.huber
    demand(method, "huber", huber is None or huber > 0, "None or a positive number")


def refuse_noise(method: NoiseSettings, place: str) -> None:
    """Refuse a noise model where a family cannot use one.

    Args:
        method: method with the settings.
        place: family with its settings, for the message.

    Raises:
        UserError: if a noise model is configured.
    """
    if NoiseChoice.of(method) is not None:
        raise UserError(
            f"{place}: cannot weigh errors by a noise model; leave noise_model and huber "
            f"out of {owner(method)}"
        )


# Noise model of the residual, a slow disturbance plus white noise, and its whitening filter.
#
# The slow part is an Ornstein-Uhlenbeck process, the white part the noise of the sensor.
# Innovations of the stationary Kalman filter of that model, divided by their deviations, are
# white: generalised least squares minimises the sum of their squares. Written once for NumPy and
# JAX. Source: Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989,
# chapter 3.


class ResidualNoise(NamedTuple):
    """Sizes of the two parts for each output; JAX reads it as a tree of its arrays."""

    time: AnyArray
    """Time constant of the slow part in s (ny,)."""
    slow: AnyArray
    """Standard deviation of the slow part, in the unit of the residuals (ny,)."""
    white: AnyArray
    """Standard deviation of the white part (ny,)."""

    @property
    def variance(self) -> AnyArray:
        """Variance of the residual (ny,)."""
        return self.slow**2 + self.white**2


class InnovationFilter(NamedTuple):
    """Kalman filter of a noise model on given samples, (..., T, ny) each.

    The prediction of the slow part follows s[k+1] = decay[k] s[k] + gain[k] e[k], s[0] = 0.
    """

    decay: AnyArray
    gain: AnyArray
    weight: AnyArray
    """Reciprocal of the deviation of the innovation; 0 where a sample does not count."""


def innovation_filter(
    noise: ResidualNoise, sampling_time: AnyArray, mask: AnyArray
) -> InnovationFilter:
    """Make the Kalman filter for outputs that count where mask (..., T, ny) is positive.

    A sample that does not count leaves the filter to its prediction, so that padding and gaps
    change no other innovation. Deviations must be positive in sum; all fields may have leading
    dimensions that fit those of `mask`.
    """
    xp = namespace(mask, *noise)
    keep = xp.exp(-sampling_time / noise.time)
    slow, white = noise.slow**2, noise.white**2
    counts = xp.moveaxis(mask, -2, 0) > 0

    def step(predicted: AnyArray, here: AnyArray) -> tuple[AnyArray, AnyArray]:
        variance = predicted + white
        gain = xp.where(here, predicted / variance, 0.0)
        after = keep**2 * (1.0 - gain) * predicted + (1.0 - keep**2) * slow
        return after, xp.stack([gain, xp.where(here, variance**-0.5, 0.0)])

    start = slow * xp.ones_like(counts[0] * slow)
    _, found = scan(step, start, counts)
    gain, weight = (xp.moveaxis(found[:, i], 0, -2) for i in range(2))
    keep = keep[..., None, :]
    return InnovationFilter(keep * (1.0 - gain), keep * gain, weight)


def innovations(through: InnovationFilter, residual: AnyArray) -> AnyArray:
    """Convert residuals (..., T, ny) to innovations in their deviations, of the same shape.

    The filter's leading dimensions are those of the residuals, or fit them.
    """
    xp = namespace(residual, through.gain)
    decay, predicted = through.decay, through.gain * residual
    shift, samples = 1, residual.shape[-2]
    # predicted[k] becomes the prediction for sample k + 1: recursive doubling, no loop over time.
    while shift < samples:
        carried = decay[..., shift:, :] * predicted[..., :-shift, :]
        later = predicted[..., shift:, :] + carried
        predicted = xp.concatenate([predicted[..., :shift, :], later], axis=-2)
        longer = decay[..., shift:, :] * decay[..., :-shift, :]
        decay = xp.concatenate([decay[..., :shift, :], longer], axis=-2)
        shift *= 2
        if xp is np and np.abs(decay).max() < 1e-30:
            break  # no prediction reaches further
    known = xp.concatenate([xp.zeros_like(predicted[..., :1, :]), predicted[..., :-1, :]], axis=-2)
    return (residual - known) * through.weight


def huber_root(error: AnyArray, threshold: float) -> AnyArray:
    """Convert errors so that their square is Huber's loss: that of the error up to the threshold,
    then growing in proportion to it."""
    xp, size = namespace(error), abs(error)
    tail = xp.sqrt(xp.maximum(2.0 * threshold * size - threshold**2, 1e-12))
    return xp.where(size <= threshold, error, xp.sign(error) * tail)


# Maximum likelihood of the noise model from the residuals of a fit, in NumPy.


NOISE_ROUNDS = 3
"""Greatest number of noise estimates, each followed by a fit."""
LEAST_DEVIATION = 1e-6
"""Share of the output's deviation below which a residual is rounding."""


def estimate_noise(
    residual: Array, mask: Array, sampling_time: float, choice: NoiseChoice, floor: Array
) -> ResidualNoise:
    """Estimate the noise from residuals.

    Without a slow part its size is 0, and so it is where it does not raise the likelihood by more
    than two parameters would by chance (Schwarz, Annals of Statistics 6(2), 1978).

    Args:
        residual: (S, T, ny).
        mask: (S, T, ny), positive where a residual counts.
        sampling_time: in s.
        choice: given and estimated parts.
        floor: least deviation (ny,).
    """
    # Subset of long data: segments spread over them, and their first part.
    length = min(residual.shape[1], 20_000)
    rows = spread(len(residual), max(1, 20_000 // length))
    residual, mask = residual[rows, :length], mask[rows, :length]
    ny, samples = residual.shape[-1], np.maximum((mask > 0).sum(axis=(0, 1)), 1.0)

    def likelihoods(time: Array, ratio: Array) -> tuple[Array, Array]:
        return _scaled_likelihoods(residual, mask, sampling_time, choice.huber, time, ratio)

    still = np.full((1, ny), sampling_time)
    plain, size = likelihoods(still, np.zeros_like(still))
    white = ResidualNoise(still[0], np.zeros_like(floor), np.maximum(size[0], floor))
    if not choice.slow:
        return white
    # Time constants from 3 samples to a quarter of the longest segment, but at least 20 samples. A
    # longer one would leave the level of the output without weight, which the errors of a poor
    # model favour.
    longest = max(0.25 * float((mask > 0).sum(axis=1).max()), 20.0)
    times = (3.0 * sampling_time, longest * sampling_time)
    ratios = (0.1, 100.0)
    # A grid in the logarithms, then four grids around the best candidate, each with half the
    # spacing.
    axes = [np.linspace(np.log(a), np.log(b), 9) for a, b in (times, ratios)]
    low, high = (np.array([axis[end] for axis in axes])[:, None, None] for end in (0, -1))
    spacing = np.array([axis[1] - axis[0] for axis in axes])
    grid = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")])
    ways = np.array([-1.0, 0.0, 1.0])
    around = np.stack([a.ravel() for a in np.meshgrid(ways, ways, indexing="ij")])
    points, outputs = np.repeat(grid[:, :, None], ny, axis=2), np.arange(ny)
    rounds = 0
    while True:
        values, sizes = likelihoods(*np.exp(points))
        best = values.argmin(axis=0)
        at = points[:, best, outputs]
        if rounds == 4:
            break
        rounds, spacing = rounds + 1, 0.5 * spacing
        points = np.clip(at[:, None] + (around * spacing[:, None])[:, :, None], low, high)
    likelihood, size = values[best, outputs], sizes[best, outputs]
    time, ratio = np.exp(at)
    size = np.maximum(size, floor / np.sqrt(1.0 + ratio**2))
    better = plain[0] - likelihood > np.log(samples)
    return ResidualNoise(
        np.where(better, time, white.time),
        np.where(better, ratio * size, white.slow),
        np.where(better, size, white.white),
    )


def _scaled_likelihoods(
    residual: Array,
    mask: Array,
    sampling_time: float,
    huber: float | None,
    time: Array,
    ratio: Array,
) -> tuple[Array, Array]:
    """Negative log likelihoods of candidates side by side, their scale at its optimum.

    Args:
        residual: (S, T, ny).
        mask: (S, T, ny), positive where a residual counts.
        sampling_time: in s.
        huber: threshold on the innovations.
        time: time constants (G, ny).
        ratio: ratios of the slow part to the white one (G, ny).

    Returns:
        Likelihoods and sizes of the white part (G, ny).
    """
    wide = time[:, None], ratio[:, None]
    unit = ResidualNoise(*wide, np.ones_like(wide[0]))
    through = innovation_filter(unit, sampling_time, mask)
    inside = mask > 0
    weight = np.where(inside, through.weight, 1.0)
    error = innovations(through, residual)
    axes, samples = (1, 2), np.maximum(inside.sum(axis=(0, 1)), 1.0)
    squares = (error**2).sum(axis=axes)
    tiny = np.finfo(float).tiny
    size = np.sqrt(np.maximum(squares / samples, tiny))
    penalty = 0.5 * samples
    if huber is not None:
        for _ in range(12):
            scaled = np.abs(error) / size[:, None, None]
            share = np.minimum(1.0, huber / np.maximum(scaled, tiny))
            size = np.sqrt(np.maximum((share * error**2).sum(axis=axes) / samples, tiny))
        scaled = np.abs(error) / size[:, None, None]
        penalty = (0.5 * huber_root(scaled, huber) ** 2).sum(axis=axes)
    return samples * np.log(size) - np.log(weight).sum(axis=axes) + penalty, size


def settled(before: ResidualNoise | None, after: ResidualNoise) -> bool:
    """Return whether two estimates in a row agree: deviations within 3 %, time constants within 10
    % where there is a slow part."""
    if before is None:
        return False
    unit = np.sqrt(after.variance)
    sizes = [np.abs(a - b) < 0.03 * unit for a, b in zip(before[1:], after[1:], strict=True)]
    times = np.abs(np.log(after.time / before.time)) < 0.1
    return bool(np.all(sizes) and np.all(times | (after.slow < 0.03 * unit)))


# Weighting of simulation errors by generalised least squares, in NumPy.


@dataclass(frozen=True)
class ErrorWeighting:
    """Whitening of errors.

    Under white noise of one output the result is the error as it was: a ridge
    keeps the deviation that it has beside least squares with residuals of the same variance.
    """

    through: InnovationFilter
    """Filter of the noise model."""
    unit: float
    """Deviation of the residuals, over the outputs in the root mean square."""
    huber: float | None
    """Threshold on the innovations in their deviations."""

    @classmethod
    def of(
        cls, noise: ResidualNoise, sampling_time: float, mask: Array, huber: float | None
    ) -> ErrorWeighting:
        """Make the weighting of errors in the unit of the noise model, where mask (S, T, ny)
        is positive."""
        unit = float(np.sqrt(noise.variance.mean()))
        return cls(innovation_filter(noise, sampling_time, mask), unit, huber)

    def __call__(self, error: Array, part: slice = slice(None)) -> Array:
        """Whiten errors (..., S, T, ny) of some segments; the results are squared."""
        found = innovations(InnovationFilter(*(a[part] for a in self.through)), error)
        if self.huber is not None:
            found = huber_root(found, self.huber)
        return self.unit * found

    def jacobian(self, error: Array, derivatives: Array) -> Array:
        """Derivatives (S, T, ny, P) of the whitened errors, from those of the errors (S, T, ny)."""
        # Column by column, so that the filter's temporary arrays are small.
        columns = [innovations(self.through, column) for column in np.moveaxis(derivatives, -1, 0)]
        found = self.unit * np.stack(columns, axis=-1)
        if self.huber is None:
            return found
        white = innovations(self.through, error)
        root = huber_root(white, self.huber)
        tail = np.abs(white) > self.huber
        slope = np.where(tail, self.huber / np.maximum(np.abs(root), self.huber), 1.0)
        return slope[..., None] * found


# Autoregressive processes of the residuals of a fit, for its uncertainty.
#
# Their order is found by Burg's method (Kay, Modern Spectral Estimation, 1988, section 7.5) and
# the criterion of Hannan and Quinn (Journal of the Royal Statistical Society B 41(2), 1979).
# Residuals are without the part of the noise that the fit absorbed, most of all where that is
# slow: the coefficients are those of restricted maximum likelihood, which uses only the part that
# no change of the fitted coordinates explains (Harville, Journal of the American Statistical
# Association 72, 1977).


# Least length of a record that is filtered block by block, and length of a block.
_MANY, _BLOCK = 65_536, 8192
# Limit on values times lags of one restricted likelihood, and on its lags: on longer records the
# fit absorbs hardly any noise.
_MOST_WORK, _MOST_RESTRICTED_LAGS = 5_000_000, 8


@dataclass(frozen=True)
class ResidualProcess:
    """Autoregressive processes, one an output, with correlated innovations."""

    filters: tuple[Array, ...]
    """Filter (1, a_1, ...) of each output."""
    covariance: Array
    """Covariance (ny, ny) of the innovations."""
    restricted: bool
    """The noise that the fit absorbed is taken into account."""

    @staticmethod
    def of(
        residuals: Sequence[Array],
        jacobians: Sequence[Array],
        nuisance: Sequence[Array],
        stretches: Sequence[Sequence[Sequence[slice]]],
    ) -> ResidualProcess:
        """Fit the processes to residuals.

        Args:
            residuals: (T, ny) of each record.
            jacobians: derivatives (T, ny, P) of each record by all that was fitted to them.
            nuisance: derivatives (T, ny, Q) by the record's own unknowns.
            stretches: those of each output of each record that are used.
        """
        outputs = range(residuals[0].shape[1])

        def cut(parts: Sequence[Array], i: int) -> list[Array]:
            return [part[s] for part, own in zip(parts, stretches, strict=True) for s in own[i]]

        segments = [cut([e[:, i] for e in residuals], i) for i in outputs]
        filters = tuple(burg(some) for some in segments)
        own = nuisance[0].shape[-1] * len(nuisance)
        work = sum(e.size for e in residuals) * (jacobians[0].shape[-1] + own)
        lags = max(len(a) for a in filters) - 1
        restricted = work * lags <= _MOST_WORK and lags <= _MOST_RESTRICTED_LAGS
        columns = [[np.zeros((len(e), 0)) for e in segments[i]] for i in outputs]
        if restricted:
            columns = [cut(_columns(jacobians, nuisance, i), i) for i in outputs]
            filters = tuple(map(_restricted, filters, segments, columns))
        lags = min(lags, min(len(e) for some in segments for e in some) - 1)
        ends = np.cumsum([len(e) for e in residuals])
        times = np.split(np.arange(ends[-1]), ends[:-1])
        white, freedom = np.zeros((ends[-1], len(outputs))), list[float]()
        for i, each in enumerate(zip(filters, segments, columns, strict=True)):
            e, x = _filtered(*each, lags)
            # Without the part that a change of the columns explains.
            e = e - x @ np.linalg.lstsq(x, e, rcond=1e-7)[0] if x.shape[1] else e
            at = np.concatenate([t[lags:] for t in cut(times, i)]).astype(np.intp)
            white[at, i] = e
            freedom.append(max(len(e) - x.shape[1] / len(filters), 1.0))
        size = np.sqrt(np.multiply.outer(freedom, freedom))
        return ResidualProcess(filters, white.T @ white / size, restricted)

    def middle(self, jacobian: Array) -> Array:
        """Covariance (P, P) of J'e of one record.

        It is the sum over time of products of the derivatives filtered backwards. The rows before
        the record belong to innovations that its residuals remember.
        """
        before = max(_memory(a, len(jacobian)) for a in self.filters)
        if len(jacobian) <= _MANY:
            padded = np.concatenate([np.zeros((before, *jacobian.shape[1:])), jacobian])
            reverse = padded[::-1]
            columns = [lfilter([1.0], a, reverse[:, i], axis=0) for i, a in enumerate(self.filters)]
            white = np.stack(columns, axis=1)[::-1]
            return np.einsum("tip,ij,tjq->pq", white, self.covariance, white)
        # Block by block, from the end of the record back: the filters go on from block to block.
        parameters = jacobian.shape[-1]
        memories = [np.zeros((len(a) - 1, parameters)) for a in self.filters]
        found = np.zeros((parameters, parameters))
        for first in range(0, len(jacobian) + before, _BLOCK):
            reverse = jacobian[::-1][first : first + _BLOCK]
            missing = min(first + _BLOCK, len(jacobian) + before) - first - len(reverse)
            reverse = np.concatenate([reverse, np.zeros((missing, *jacobian.shape[1:]))])
            columns = list[Array]()
            for i, a in enumerate(self.filters):
                column, memories[i] = lfilter([1.0], a, reverse[:, i], axis=0, zi=memories[i])
                columns.append(column)
            white = np.stack(columns, axis=1)
            found += np.einsum("tip,ij,tjq->pq", white, self.covariance, white, optimize=True)
        return found

    def independent(self, samples: int) -> float:
        """Number of independent samples that give a variance with the same relative error
        (Bartlett)."""
        shares: list[float] = []
        for a in self.filters:
            # Reciprocal of the sum of the squared correlations at all lags, which vanish before
            # 4096 samples.
            spectrum = np.abs(np.fft.rfft(lfilter([1.0], a, _impulse(4096)), 2 * 4096)) ** 2
            correlation = np.fft.irfft(spectrum)
            shares.append(float(correlation[0] ** 2 / (correlation**2).sum()))
        return samples * float(np.mean(shares))


def burg(segments: Sequence[Array]) -> Array:
    """Filter (1, a_1, ...) that whitens the segments (T,), its order by the criterion of Hannan and
    Quinn."""
    longest = max(len(segment) for segment in segments)
    samples = sum(len(segment) for segment in segments)
    most = min(30, int(0.1 * longest))  # more lags would be fitted to chance
    forward, backward = [np.array(p) for p in segments], [np.array(p) for p in segments]
    power = sum(float(p @ p) for p in segments) / samples
    best, chosen = samples * np.log(max(power, 1e-300)), np.ones(1)
    a, penalty = np.ones(1), 2.0 * np.log(np.log(max(samples, 16)))
    for order in range(1, most + 1):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True) if len(f) > 1]
        energy = sum(float(f @ f + b @ b) for f, b in pairs)
        if energy <= 0 or power <= 0:
            break
        k = -2.0 * sum(float(f @ b) for f, b in pairs) / energy
        a = _with_reflection(a, k)
        forward, backward = [f + k * b for f, b in pairs], [b + k * f for f, b in pairs]
        power *= 1.0 - k * k
        criterion = samples * np.log(max(power, 1e-300)) + penalty * order
        if criterion < best:
            best, chosen = criterion, a
    return chosen


def _memory(a: Array, most: int) -> int:
    """Number of samples after which an impulse through 1/a has decayed."""
    if len(a) == 1:
        return 0
    response = np.abs(lfilter([1.0], a, _impulse(most)))
    large = np.flatnonzero(response > 1e-3 * response.max())
    return int(large[-1]) + 1


def _impulse(samples: int) -> Array:
    return np.concatenate([np.ones(1), np.zeros(samples - 1)])


def _columns(jacobians: Sequence[Array], nuisance: Sequence[Array], output: int) -> list[Array]:
    """Derivatives (T, K) of one output in each record, those by a record's own unknowns in separate
    columns."""
    found = [j[:, output] for j in jacobians]
    own, count = nuisance[0].shape[-1], len(nuisance)
    wide = [np.zeros((len(part), own * count)) for part in found]
    for k, (part, block) in enumerate(zip(wide, nuisance, strict=True)):
        part[:, k * own : (k + 1) * own] = block[:, output]
    return [np.hstack(both) for both in zip(found, wide, strict=True)]


def _restricted(a: Array, segments: Sequence[Array], columns: Sequence[Array]) -> Array:
    """Filter of restricted maximum likelihood, of the same order."""
    order = len(a) - 1
    if not order:
        return a

    def stable(points: Array) -> Array:
        return _filter(0.999 * np.tanh(points))

    def criterion(points: Array) -> float:
        e, x = _filtered(stable(points), segments, columns, order)
        left, sizes, _ = np.linalg.svd(x, full_matrices=False)
        kept = sizes > 1e-7 * sizes.max(initial=1e-300)
        e = e - left[:, kept] @ (left[:, kept].T @ e)
        rest = max(len(e) - int(kept.sum()), 1)
        return rest * float(np.log(max(e @ e, 1e-300))) + 2.0 * float(np.log(sizes[kept]).sum())

    # Reflection coefficients, by Levinson's recursion backwards.
    reflections: list[float] = []
    rest = a
    while len(rest) > 1:
        k = float(rest[-1])
        reflections.insert(0, k)
        rest = ((rest - k * rest[::-1]) / max(1.0 - k * k, 1e-12))[:-1]
    start = np.arctanh(np.clip(np.array(reflections) / 0.999, -0.9999, 0.9999))
    from scipy.optimize import minimize  # loading takes long

    found = minimize(criterion, start, method="BFGS", options={"maxiter": 30, "gtol": 1e-3})
    better = np.isfinite(found.fun) and found.fun < criterion(start)
    return stable(found.x) if better else a


def _filtered(
    a: Array, segments: Sequence[Array], columns: Sequence[Array], lags: int
) -> tuple[Array, Array]:
    """Residuals (N,) and columns (N, K) through a filter, without the samples before which the past
    is missing."""
    lags = min(lags, min(map(len, segments)) - 1)
    e = np.concatenate([lfilter(a, [1.0], segment)[lags:] for segment in segments])
    if not columns[0].shape[1]:
        return e, np.zeros((len(e), 0))
    return e, np.concatenate([lfilter(a, [1.0], part, axis=0)[lags:] for part in columns])


def _filter(reflections: Array) -> Array:
    """Filter (1, a_1, ...) from reflection coefficients: stable where these are within 1."""
    return reduce(_with_reflection, reflections, np.ones(1))


def _with_reflection(a: Array, k: float) -> Array:
    longer = np.concatenate([a, [0.0]])
    return longer + k * longer[::-1]
