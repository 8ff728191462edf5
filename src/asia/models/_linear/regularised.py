"""Linear model from a regularised impulse response or difference equation, reduced to few states.

The coefficients of each signal have a prior that decays with the lag and is smooth (the tuned and
correlated kernel). Its sizes and decays, and the noise, maximise the marginal likelihood. Sources:
Chen, Ohlsson and Ljung, Automatica 48(8), 2012; Pillonetto and others, Automatica 50(3), 2014;
Moore, IEEE Trans. Automatic Control 26(1), 1981 (balanced reduction).
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._least_squares import solve_or_fit
from asia.models._linear.fit import LinearFit, encoder_of
from asia.models._linear.response import DrivenRecords
from asia.models._linear.system import LinearSystem
from asia.models._linear.window_predictor import WindowLags
from asia.models._numerics.encoder import Encoder
from asia.models._numerics.training_records import Indices, ScaledData, output_groups

Form: TypeAlias = Literal["response", "equation"]

# Lags of inputs and outputs: an impulse response needs its whole length, an equation does not.
_LAGS: dict[Form, tuple[int, int]] = {"response": (60, 0), "equation": (40, 20)}
# Least samples for each coefficient of an output, the most coefficients, and rows of regressors in
# memory at a time.
_SAMPLES, _MOST, _CHUNK = 2.0, 300, 8192
_ITERATIONS = 60
# Hankel singular values below this share of the largest are left out, and the greatest order.
_LEAST_SHARE, _MOST_STATES = 2e-3, 40
# Doublings of the sums for the Gramians: enough for a time constant of so many samples, 2^16.
_DOUBLINGS = 16
# Weight of zero initial states of the records, in squared errors of a sample.
_INITIAL_RIDGE = 3.0


def fit_regularised(
    records: ScaledData, context: Context, form: Form, order: int | None = None
) -> tuple[LinearSystem, Encoder] | None:
    """Fit "response" (the output by past inputs) or "equation" (by past outputs too).

    Args:
        records: training records.
        context: context of the fit.
        form: kind of the regression.
        order: states of the reduced system; None keeps those that matter.

    Returns:
        System and encoder; None where the equation is unstable, the records are too short, or an
            output is constant.
    """
    nu, ny = context.nu, context.ny
    total = sum(len(r) for r in records)
    most_u, most_y = _LAGS[form]
    most, longest = min(_MOST, total / _SAMPLES), max(len(r) for r in records)
    share = min(1.0, most / (nu * most_u + ny * most_y), 0.5 * longest / most_u)
    n, m = int(share * most_u), int(share * most_y)
    if n < 2:
        return None
    lags = WindowLags(n, m, n - 1, m, nu, ny)
    sizes = [n] * nu + [m] * ny * (m > 0)
    theta, offset = np.zeros((sum(sizes), ny)), np.zeros(ny)
    for _, outputs in output_groups(np.concatenate([r.weight for r in records])):
        gram, moment, squares, mean_x, mean_y, count = _products(records, n, m, outputs)
        if count < n + m or not (squares > 0).all():
            return None
        for k, cross, square in zip(outputs, moment.T, squares, strict=True):
            theta[:, k] = _coefficients(gram, cross, square, count, sizes)
        offset[outputs] = mean_y - mean_x @ theta[:, outputs]
    system = _realised(theta, offset, lags, order)
    if system is None:
        return None
    # Initial states of the records, with which the encoder learns from the states.
    zero = np.zeros((len(records), system.order))
    normal, gradient = DrivenRecords(records).response(system, zero).normal_equations(poles=False)
    last = zero.size
    ridge = _INITIAL_RIDGE * np.eye(last)
    found = solve_or_fit(normal[-last:, -last:] + ridge, gradient[-last:])
    x0 = found.reshape(zero.shape)
    response = DrivenRecords(records).response(system, x0)
    context.log(0, float(np.sqrt(response.error)))
    return system, encoder_of(records, LinearFit(system, x0, response.error), context)


def _products(
    records: ScaledData, n: int, m: int, outputs: Indices
) -> tuple[Array, Array, Array, Array, Array, float]:
    """Products of centred regressors with themselves and with outputs that count at the same
    samples, squares of the outputs, both means and the number of samples. Regressors: n inputs from
    the newest on, then m past outputs, signal by signal."""
    nu, ny, wanted = records[0].u.shape[1], records[0].y.shape[1], len(outputs)
    width = nu * n + ny * m + wanted
    gram, total, count = np.zeros((width, width)), np.zeros(width), 0.0
    first = max(n - 1, m)
    for r in records:
        lost = np.concatenate([[0], np.cumsum((r.weight == 0).any(axis=1))])
        every = np.arange(first, len(r))
        every = every[(r.weight[every, outputs[0]] > 0) & (lost[every] == lost[every - m])]
        for begin in range(0, len(every), _CHUNK):
            k = every[begin : begin + _CHUNK, None]
            past = [r.u[k - np.arange(n), j] for j in range(nu)]
            past += [r.y[k - np.arange(1, m + 1), j] for j in range(ny)] if m else []
            rows = np.concatenate([*past, r.y[k, outputs]], axis=1)
            gram += rows.T @ rows
            total += rows.sum(axis=0)
            count += len(rows)
    mean = total / max(count, 1.0)
    gram -= count * np.outer(mean, mean)
    x, y = slice(0, width - wanted), slice(width - wanted, width)
    return gram[x, x], gram[x, y], np.diagonal(gram)[y], mean[x], mean[y], count


def _coefficients(
    gram: Array, moment: Array, square: float, count: float, sizes: list[int]
) -> Array:
    """Coefficients (d,) of one output at the greatest marginal likelihood.

    The kernel c lambda^max(i, j) is that of sums of independent increments, so that products with
    running sums of the regressors need a diagonal prior only.
    """
    from scipy.linalg import solve_triangular
    from scipy.optimize import minimize  # loading takes long

    ends = np.cumsum(sizes)
    groups = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
    sums = np.zeros_like(gram)
    for g in groups:
        sums[g, g] = np.triu(np.ones((g.stop - g.start,) * 2))
    gram, moment = sums.T @ gram @ sums, sums.T @ moment
    d = len(gram)

    def prior(theta: Array) -> tuple[Array, Array]:
        """Variances of the increments, and their derivatives by the decays."""
        variances, slopes = np.zeros(d), np.zeros(d)
        for g, size, decay in zip(groups, theta[:-1:2], theta[1:-1:2], strict=True):
            i, rate = np.arange(1, g.stop - g.start + 1), 1.0 / (1.0 + np.exp(-decay))
            here, by = rate**i, i * rate ** (i - 1)
            here[:-1] -= rate ** i[1:]
            by[:-1] -= i[1:] * rate ** i[:-1]
            variances[g] = np.exp(size) * here
            slopes[g] = np.exp(size) * by * rate * (1.0 - rate)
        return variances, slopes

    def solved(variances: Array, noise: float) -> tuple[Array, Array, Array]:
        """Factor of the normal matrix, its inverse, and the weights of the increments."""
        root = np.sqrt(variances)
        matrix = root[:, None] * gram * root + noise * np.eye(d)
        factor = np.asarray(np.linalg.cholesky(matrix), np.float64)
        inverse = solve_triangular(factor, np.eye(d), lower=True, check_finite=False)
        return factor, inverse, root * (inverse.T @ (inverse @ (root * moment)))

    def cost(theta: Array) -> tuple[float, Array]:
        (variances, slopes), noise = prior(theta), np.exp(theta[-1])
        try:
            factor, inverse, weights = solved(variances, noise)
        except np.linalg.LinAlgError:
            return 1e12, np.zeros_like(theta)
        rest = square - weights @ moment
        value = (count - d) * theta[-1] + 2.0 * np.log(np.diagonal(factor)).sum() + rest / noise
        # Relative slopes by the variances: with S the inverse covariance of the outputs y, the
        # diagonal of X' S X less the square of X' S y.
        spread = noise * (inverse**2).sum(axis=0)
        by = 1.0 - spread - variances * ((moment - gram @ weights) / noise) ** 2
        gradient = [v for g in groups for v in (by[g].sum(), by[g] @ (slopes / variances)[g])]
        errors = rest - weights @ (moment - gram @ weights)
        return value, np.array([*gradient, count - d + spread.sum() - errors / noise])

    # Small coefficients with a memory of 20 samples.
    start = np.array([v for _ in groups for v in (-6.0, 3.0)] + [np.log(0.05 * square / count)])
    bounds = [b for _ in groups for b in ((-20.0, 8.0), (-3.0, 6.0))] + [(-25.0, 5.0)]
    found = minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxiter": _ITERATIONS},
    )  # fmt: skip
    return sums @ solved(prior(found.x)[0], float(np.exp(found.x[-1])))[2]


def _realised(
    theta: Array, offset: Array, lags: WindowLags, order: int | None
) -> LinearSystem | None:
    """Balanced system of few states with the coefficients; None where it is unstable."""
    n, m, nu, ny = lags.u + 1, lags.y, lags.nu, lags.ny
    by_u = theta[: nu * n].reshape(nu, n, ny)
    by_y = theta[nu * n :].reshape(ny, m, ny) if m else np.zeros((ny, 0, ny))
    # The oldest sample comes first in the state, and the signals of a sample together.
    old_u = by_u[:, :0:-1].transpose(1, 0, 2).reshape(-1, ny)
    old_y = by_y[:, ::-1].transpose(1, 0, 2).reshape(-1, ny)
    by_x, d = np.concatenate([old_u, old_y]), by_u[:, 0]
    s, from_u, from_y = lags.shift()
    a, b, c = (s + by_x @ from_y).T, (from_u + d @ from_y).T, by_x.T
    if abs(np.linalg.eigvals(a)).max(initial=0.0) >= 1.0 - 1e-6:
        return None
    # Outputs that start at the constant that they settle at.
    gain = np.eye(ny) - by_y.sum(axis=1).T
    level = np.linalg.solve(gain, offset)
    reach, seen, power = b @ b.T, c.T @ c, a
    for _ in range(_DOUBLINGS):
        reach, seen = reach + power @ reach @ power.T, seen + power.T @ seen @ power
        power = power @ power
    roots = [_root(0.5 * (w + w.T)) for w in (reach, seen)]
    left, values, right = np.linalg.svd(roots[1].T @ roots[0], full_matrices=False)
    count = min(_MOST_STATES, int((values > _LEAST_SHARE * values[0]).sum()))
    kept = slice(0, min(order or max(count, 1), len(values)))
    scale = 1.0 / np.sqrt(values[kept])
    into = (left[:, kept] * scale).T @ roots[1].T
    back = roots[0] @ right[kept].T * scale
    # Stored and reloaded arrays are contiguous; products with views would differ in the last bit.
    parts = into @ a @ back, into @ b, c @ back, d.T, level
    return LinearSystem(*(np.ascontiguousarray(part) for part in parts))


def _root(square: Array) -> Array:
    values, vectors = np.linalg.eigh(square)
    return vectors * np.sqrt(np.maximum(values, 0.0))
