"""Linear models of measured frequency responses, with an open delay.

Starts come from a subspace method, the model from weighted least squares of the response, the order
from cross-validation over interleaved frequencies. Sources: McKelvey, Akcay and Ljung, IEEE Trans.
Automatic Control 41, 1996 (subspace method); Pintelon and Schoukens, System Identification: A
Frequency Domain Approach, 2nd ed., chapters 8 and 9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asia.data.frequency import ComplexArray, FrequencyRecord
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.lowering.linear import LinearModel, discretize

_FOLDS, _LARGEST = 3, 24
# A smaller order is taken while its held-out error is at most this much larger than the least one.
_WORSE = 1.05
# Steps to an end of the interval of the delay.
_WIDENINGS = 14
# Relative error that counts as none.
_EXACT = 1e-7
# Delays on the grid, and the longest one in turns of the phase at the highest frequency.
_DELAYS, _TURNS = 16, 6.0
# Frequencies that the delays are sought at.
_COARSE = 150
_FEW, _ITERATIONS = 15, 60
# Raw unstable poles are kept where they lower the error to this part of that without.
_UNSTABLE = 0.5


@dataclass(frozen=True)
class FrequencyFit:
    """Linear model of a frequency response."""

    record: FrequencyRecord
    model: LinearModel
    """Without the delay; in continuous time where the record is."""
    delay: float
    """In s, the same for all inputs and outputs."""
    delay_band: tuple[float, float]
    """Its 95 % interval in s, by the likelihood ratio."""
    folds: tuple[tuple[LinearModel, float], ...]
    """Models and delays without every third frequency."""
    error: float
    """Root of the mean squared error over its standard deviation, where the variance is known; else
    relative to the response."""
    held_out: float
    """The same at frequencies that a fold did not see."""
    tried: tuple[tuple[int, float], ...]
    """Orders with their held-out errors."""

    def response(self, frequency: Array) -> ComplexArray:
        """Response (F, ny, nu) with the delay at frequencies in Hz."""
        return delayed_response(self.model, self.delay, frequency)


def delayed_response(model: LinearModel, delay: float, frequency: Array) -> ComplexArray:
    """Response (F, ny, nu) of a model after a delay in s."""
    turn = np.exp(-2j * math.pi * frequency * delay)
    return model.response(frequency) * turn[:, None, None]


@dataclass(frozen=True)
class _System:
    """Linear system in the variable of the data, and a delay in s."""

    a: Array
    b: Array
    c: Array
    d: Array
    delay: float

    def response(self, data: _Data) -> ComplexArray:
        inside = data.p[:, None, None] * np.eye(len(self.a)) - self.a
        plain = self.c @ np.linalg.solve(inside, self.b.astype(np.complex128)) + self.d
        return plain * np.exp(-data.s * self.delay)[:, None, None]


@dataclass(frozen=True)
class _Data:
    """Response with weights at some frequencies."""

    z: ComplexArray
    """Points of the unit circle."""
    p: ComplexArray
    """Variable of the systems: z, or s over the middle of the frequencies in continuous time."""
    s: ComplexArray
    response: ComplexArray
    weight: Array

    def at(self, chosen: NDArray[np.bool_]) -> _Data:
        return _Data(self.z[chosen], self.p[chosen], self.s[chosen], self.response[chosen],
                     self.weight[chosen])  # fmt: skip

    def error(self, system: _System) -> float:
        apart = self.weight * (self.response - system.response(self))
        size = float(np.sqrt(np.mean(np.abs(apart) ** 2)))
        return size if math.isfinite(size) else math.inf

    @property
    def continuous(self) -> bool:
        return self.p is not self.z and not np.array_equal(self.p, self.z)

    def is_stable(self, system: _System) -> bool:
        poles = np.linalg.eigvals(system.a)
        return bool((poles.real < 0).all() if self.continuous else (np.abs(poles) < 1.0).all())


def fit_frequency_response(record: FrequencyRecord, order: int | None = None) -> FrequencyFit:
    """Fit a linear model with a delay.

    Args:
        order: number of states; None: by cross-validation

    Raises:
        UserError: for an order that the frequencies do not determine
    """
    # Responses are about 1 in these units of the outputs and inputs.
    sizes = np.sqrt((np.abs(record.response) ** 2).mean(axis=0))
    levels = np.log(np.where(sizes > 0, sizes, 1.0))
    y, u = np.exp(levels.mean(axis=1)), np.exp(levels.mean(axis=0) - levels.mean())
    units = y[:, None] * u
    variance = None if record.variance is None else record.variance / units**2
    scaled = replace(record, response=record.response / units, variance=variance)
    w = 2.0 * math.pi * record.frequency
    s = np.asarray(1j * w, np.complex128)
    # Continuous time: the bilinear map to the unit circle, around the middle of the frequencies.
    positive = w[w > 0]
    middle = math.exp(float(np.log(positive).mean()))
    z = (
        np.exp(s * record.sampling_time) if record.sampling_time
        else (1.0 + s / middle) / (1.0 - s / middle)
    )  # fmt: skip
    weight = response_weight(scaled)
    p = z if record.sampling_time else s / middle
    data = _Data(z, p, s, scaled.response, weight)
    _, ny, nu = record.response.shape
    most = min(_LARGEST, len(w) * min(ny, nu) // 4)
    if order is not None and not 1 <= order <= most:
        raise UserError(f"order is {order}, expected 1 to {most} for {len(w)} frequencies")
    number = np.arange(len(w))
    coarse = data.at(number % max(len(w) // _COARSE, 1) == 0)
    parts = [(data.at(number % _FOLDS != k), data.at(number % _FOLDS == k)) for k in range(_FOLDS)]
    scale = float(np.sqrt(np.mean(np.abs(weight * scaled.response) ** 2)))

    def held_out(n: int, delays: Sequence[float], strict: bool) -> tuple[float, list[_System]]:
        folds = [_fitted(seen, n, delays, _FEW, strict) for seen, _ in parts]
        errors = [held.error(one) for (_, held), one in zip(parts, folds, strict=True)]
        return float(np.sqrt(np.mean(np.square(errors)))), folds

    found: dict[int, tuple[float, list[_System]]] = {}
    for n in [order] if order is not None else range(1, most + 1):
        found[n] = held_out(n, _best_delays(coarse, n), strict=False)
        best = min(found, key=lambda k: found[k][0])
        # Beyond a clear minimum no larger order is tried.
        if found[best][0] < _EXACT * scale or (n >= best + 4 and n >= 6):
            break
    enough = max(_WORSE * min(error for error, _ in found.values()), _EXACT * scale)
    chosen = min(n for n, (error, _) in found.items() if error <= enough)
    tried = tuple((n, error) for n, (error, _) in found.items())
    # Without a direct path, where the response does not need one: it blurs the delay.
    error, folds = found[chosen]
    delays = [*_best_delays(data, chosen), *(one.delay for one in folds)]
    without = held_out(chosen, delays, strict=True)
    strict = without[0] <= max(_WORSE * error, _EXACT * scale)
    error, folds = without if strict else (error, folds)
    system = _fitted(data, chosen, delays, _ITERATIONS, strict)

    def model(one: _System) -> LinearModel:
        rate, zeros = 1.0 if record.sampling_time else middle, (np.zeros(nu), np.zeros(ny))
        made = LinearModel(
            rate * one.a, rate * one.b, one.c, one.d, record.sampling_time, *zeros
        )  # fmt: skip
        return made.scaled(u, 1.0 / y)

    return FrequencyFit(
        record, model(system), system.delay, _delay_band(data, system, strict),
        tuple((model(one), one.delay) for one in folds), data.error(system), error, tried,
    )  # fmt: skip


def _fitted(
    data: _Data, order: int, delays: Sequence[float], iterations: int, strict: bool
) -> _System:
    """The best starts for these delays, refined with the delay open."""
    starts = [one for delay in delays for one in _starts(data, order, delay, strict)]
    starts.sort(key=data.error)
    refined = [_refined(data, one, iterations, strict) for one in starts[:2]]
    best = min(refined, key=data.error)
    stable = [one for one in refined if data.is_stable(one)]
    calm = min(stable, key=data.error, default=best)
    return calm if data.error(calm) * _UNSTABLE < data.error(best) else best


def _delay_band(data: _Data, best: _System, strict: bool) -> tuple[float, float]:
    """Delays up to where the other parameters no longer make up for them."""
    count = data.response.size
    cost = count * data.error(best) ** 2
    parameters = len(best.a) * sum(best.d.shape) + best.d.size * (not strict) + 1
    limit = cost * (1.0 + 1.92 / max(count - 0.5 * parameters, 1.0))
    ends: list[float] = []
    for sign in (-1.0, 1.0):
        one, before, width = best, cost, sign * 0.05 / float(data.s.imag.max())
        end = best.delay
        for _ in range(_WIDENINGS):
            end = max(one.delay + width, 0.0)
            there = _refined(data, replace(one, delay=end), _FEW, strict, hold=True)
            after = count * data.error(there) ** 2
            if after >= limit:
                share = math.sqrt(max(limit - before, 0.0) / (after - before))
                end = one.delay + share * (end - one.delay)
                break
            if end == 0.0:
                break
            one, before, width = there, after, 1.5 * width
        ends.append(end)
    return ends[0], ends[1]


def _best_delays(data: _Data, order: int) -> list[float]:
    """Delays whose starts have the least errors."""
    highest = float(data.s.imag.max())
    grid = (2.0 * math.pi / highest * np.linspace(0.0, _TURNS, _DELAYS)).tolist()
    errors = [
        min((data.error(one) for one in _starts(data, order, delay)), default=math.inf)
        for delay in grid
    ]
    return [grid[k] for k in np.argsort(errors)[:2]]


def _starts(data: _Data, order: int, delay: float, strict: bool = False) -> list[_System]:
    """Subspace estimate for a delay, and the same with stable poles."""
    response = data.response * np.exp(data.s * delay)[:, None, None]
    count, ny, nu = response.shape
    rows = min(2 * order + 6, max(order + 2, count // (2 * nu)))
    powers = data.z[:, None] ** np.arange(rows)
    mean = data.weight.mean(axis=(1, 2))[:, None, None, None]
    stacked = (mean * powers[:, :, None, None] * response[:, None]).reshape(count, rows * ny, nu)
    inputs = (mean * powers[:, :, None, None] * np.eye(nu)).reshape(count, rows * nu, nu)
    both = np.concatenate([inputs, stacked], axis=1).transpose(1, 0, 2).reshape(-1, count * nu)
    real = np.concatenate([np.real(both), np.imag(both)], axis=1)
    triangle = np.asarray(np.linalg.qr(real.T, mode="r"), np.float64).T
    rest = triangle[rows * nu :, rows * nu :]
    left, sizes, _ = np.linalg.svd(rest, full_matrices=False)
    if len(sizes) < order or rows * ny - ny < order:
        return []
    seen = left[:, :order]
    a = np.linalg.lstsq(seen[:-ny], seen[ny:], rcond=None)[0]
    c = seen[:ny]
    found: list[_System] = []
    poles, ways = np.linalg.eig(a)
    matrices: list[Any] = [a]
    if np.abs(poles).max() >= 1.0 and np.linalg.cond(ways) < 1e8:
        inside = np.where(
            np.abs(poles) >= 1.0, 1.0 / np.maximum(np.abs(poles), 1.0 + 1e-6) ** 2, 1.0
        )
        matrices.append(np.real(ways @ np.diag(poles * inside) @ np.linalg.inv(ways)))
    for matrix in matrices:
        try:
            if data.continuous:
                matrix = np.linalg.inv(matrix + np.eye(order)) @ (matrix - np.eye(order))
            b, d = _zeros_part(replace(data, response=response), matrix, c, strict)
        except np.linalg.LinAlgError:
            continue
        found.append(_System(matrix, b, c, d, delay))
    return found


def _zeros_part(data: _Data, a: Array, c: Array, strict: bool) -> tuple[Array, Array]:
    """B and D by weighted least squares; D is 0 where the system is strictly proper."""
    n, (ny, nu) = len(a), data.response.shape[1:]
    inside = np.linalg.inv(data.p[:, None, None] * np.eye(n) - a)
    direct = np.broadcast_to((0.0 if strict else 1.0) * np.eye(ny), (len(data.p), ny, ny))
    known = np.concatenate([c @ inside, direct], axis=2)
    columns: list[Any] = []
    for j in range(nu):
        weight = data.weight[:, :, j]
        left = (weight[..., None] * known).reshape(-1, n + ny)
        right = (weight * data.response[:, :, j]).reshape(-1)
        columns.append(
            np.linalg.lstsq(
                np.concatenate([left.real, left.imag]),
                np.concatenate([right.real, right.imag]), rcond=1e-12,
            )[0]
        )  # fmt: skip
    both = np.stack(columns, axis=1)
    return both[:n], both[n:]


def _refined(
    data: _Data, start: _System, iterations: int, strict: bool, *, hold: bool = False
) -> _System:
    """Levenberg-Marquardt on all matrices and the delay, with exact derivatives.

    Args:
        strict: whether D stays 0
        hold: whether the delay stays
    """
    n, nu = start.b.shape
    ny = len(start.c)
    pace = 1.0 / float(data.s.imag.max())

    def system(theta: Array) -> _System:
        a, b, c, d, delay = np.split(theta, np.cumsum([n * n, n * nu, ny * n, ny * nu]))
        return _System(
            a.reshape(n, n), b.reshape(n, nu), c.reshape(ny, n), (not strict) * d.reshape(ny, nu),
            float(delay[0]) * pace,
        )  # fmt: skip

    def slopes(one: _System) -> Array:
        turn = np.exp(-data.s * one.delay)[:, None, None]
        whole = one.response(data)
        full = response_slopes(one.a, one.b, one.c, data.p) * turn[..., None]
        full[..., full.shape[-1] - ny * nu :] *= not strict
        by_delay = (not hold) * (-data.s * pace)[:, None, None] * whole
        full = data.weight[..., None] * np.concatenate([full, by_delay[..., None]], axis=3)
        full = full.reshape(-1, len(theta))
        return np.concatenate([full.real, full.imag])

    def residual(one: _System) -> Array:
        apart = (data.weight * (data.response - one.response(data))).reshape(-1)
        return np.concatenate([apart.real, apart.imag])

    theta: Any = np.concatenate(
        [start.a.ravel(), start.b.ravel(), start.c.ravel(), start.d.ravel(), [start.delay / pace]]
    )
    rest = residual(start)
    cost, damping = float(rest @ rest), 1e-3
    for _ in range(iterations):
        jacobian = slopes(system(theta))
        gram, gradient = jacobian.T @ jacobian, jacobian.T @ rest
        before = cost
        for _ in range(8):
            ridge = damping * (np.diag(gram) + 1e-9 * np.diag(gram).max())
            move = np.linalg.lstsq(gram + np.diag(ridge), gradient, rcond=None)[0]
            trial = theta + move
            trial[-1] = max(trial[-1], 0.0)
            with np.errstate(all="ignore"):
                there = residual(system(trial))
                new = float(there @ there)
            if math.isfinite(new) and new < cost:
                theta, rest, cost, damping = trial, there, new, max(damping / 5.0, 1e-12)
                break
            damping *= 6.0
        if cost > before * (1.0 - 1e-7):
            break
    return system(theta)


def response_slopes(a: Array, b: Array, c: Array, p: ComplexArray) -> ComplexArray:
    """Derivatives (F, ny, nu, parameters) of C (p - A)^-1 B + D by A, B, C and D, at p (F,)."""
    n, nu, ny, count = len(a), b.shape[1], len(c), len(p)
    inside = np.linalg.inv(p[:, None, None] * np.eye(n) - a)
    left, right = c @ inside, inside @ b
    parts = [
        np.einsum("foi,fju->fouij", left, right),
        np.einsum("foi,uv->fouiv", left, np.eye(nu)),
        np.einsum("op,fju->foupj", np.eye(ny), right),
        np.einsum("op,uv,f->foupv", np.eye(ny), np.eye(nu), np.ones(count)),
    ]
    return np.concatenate([one.reshape(count, ny, nu, -1) for one in parts], axis=3)


def response_starts(
    z: ComplexArray, response: ComplexArray, weight: Array, order: int
) -> list[tuple[Array, Array, Array, Array]]:
    """Return subspace estimates (A, B, C, D) of a sampled response (F, ny, nu), the best first.

    Args:
        z: points (F,) of the unit circle
        weight: weights (F, ny, nu) of the errors
    """
    data = _Data(z, z, np.log(z), response, weight)
    stable = [one for one in _starts(data, order, 0.0) if data.is_stable(one)]
    found = sorted(stable, key=data.error)
    return [(one.a, one.b, one.c, one.d) for one in found]


def response_weight(record: FrequencyRecord) -> Array:
    """Weights (F, ny, nu) of the errors: over the standard deviation, where the variance is known;
    else relative to the response."""
    if record.variance is not None:
        return 1.0 / np.sqrt(record.variance)
    size = np.abs(record.response)
    return 1.0 / (size + 0.05 * np.median(size, axis=0))


def sampled_response(fit: FrequencyFit, sampling_time: float) -> FrequencyRecord:
    """Return the response of the sampled system, whose inputs are held between samples.

    The hold multiplies the measured response; what it folds back from above half the sampling
    frequency, a small part, is that of the model.
    """
    record, model = fit.record, fit.model
    if record.sampling_time:
        return record
    whole, part = divmod(fit.delay / sampling_time, 1.0)
    a, full = discretize(model.a, model.b, sampling_time)
    _, late = discretize(model.a, model.b, (1.0 - part) * sampling_time)
    turn = 2j * np.pi * record.frequency * sampling_time
    z = np.exp(turn)[:, None, None]
    driven = np.linalg.solve(z * np.eye(len(a)) - a, late + (full - late) / z)
    sampled = (model.c @ driven + model.d * (1.0 / z if part > 0 else 1.0)) * z**-whole
    with np.errstate(all="ignore"):
        hold = np.where(turn == 0, 1.0, (1.0 - np.exp(-turn)) / turn)[:, None, None]
    response = hold * (record.response - fit.response(record.frequency)) + sampled
    variance = None if record.variance is None else np.abs(hold) ** 2 * record.variance
    return replace(record, response=response, variance=variance, sampling_time=sampling_time)
