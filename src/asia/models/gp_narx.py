"""Gaussian-process NARX model for short records.

y[k] = m(z) + g(z), z = lagged outputs and inputs: m the best ARX model (or the last output held)
and g a Gaussian process for each output with a squared exponential kernel, one length scale for
each regressor. Free-run simulation uses the predictive mean, held within a multiple of the training
range. Beyond `points` samples only so many, spread evenly, are kept: the cost of a fit grows with
their cube, that of a simulated sample with their number.
Sources: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapters 2 and 5;
Kocijan, Modelling and Control of Dynamic Systems Using Gaussian Process Models, 2016.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models._arrays import AnyArray, namespace
from asia.models._config import Progress, check_at_least, check_choice
from asia.models._numerics.lags import FreeRun, Lags, OutputRange, fit_history, regressors
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import left_out_error, segments, simulation_error
from asia.models._numerics.training_records import ScaledData, check, scaled, spread
from asia.models._one_step import (
    FreeRunModel,
    LagChoice,
    build,
    candidate_lags,
    linear_run,
    selection,
    usable,
)
from asia.models.methods import MarginalLikelihood

__all__ = ["Config", "build", "train"]

_JITTER = 1e-8


@dataclass(frozen=True)
class Config:
    """Lags of the regressors, and size and mean of the Gaussian process."""

    na: int | None = None
    """Lagged outputs; None chooses among 1..max_order by the simulation error on segments left out
    of the training data, one number for all lags left open."""
    nb: int | None = None
    """Lagged inputs, chosen alike."""
    delay: int | None = 0
    """Samples before the newest input that acts: 0 lets u[k] act on y[k], None chooses among 0..10
    by a linear model."""
    mean: Literal["linear", "hold"] = "linear"
    """Mean function of the process: the best ARX model, or the last output held."""
    points: int = 800
    """Training samples kept; the cost of a fit grows with their cube."""
    max_order: int = 4
    """Greatest number of lags tried where `na` or `nb` is None."""
    margin: float = 0.1
    """Permitted excess of outputs in free run over the training range, as a multiple of its
    width."""

    def __post_init__(self) -> None:
        check_choice(self, "mean", ("linear", "hold"))
        check_at_least(1, self, "na", "nb", "max_order", "points")
        check_at_least(0, self, "delay", "margin")


@dataclass(frozen=True)
class OutputProcess:
    """Gaussian process of one output."""

    scaled: Array
    """Training regressors (N, d) over the length scales."""
    lengths: Array
    """Length scales (d,)."""
    weights: Array
    """(N,), with the kernel's variance in them."""

    def __call__(self, z: AnyArray) -> AnyArray:
        """Predictive mean (B, d) -> (B,)."""
        return namespace(z).exp(-0.5 * _distances(z / self.lengths, self.scaled)) @ self.weights


@dataclass(frozen=True)
class GaussianPredictor:
    """Prediction of the next outputs."""

    mean: Array
    """Coefficients (1 + d, ny) of [1, z]."""
    processes: tuple[OutputProcess, ...]
    """Gaussian processes, one an output."""

    def __call__(self, z: AnyArray) -> AnyArray:
        """Predict (B, d) -> (B, ny)."""
        line = self.mean[0] + z @ self.mean[1:]
        return line + namespace(z).stack([p(z) for p in self.processes], axis=1)


def train(
    model: FreeRunModel[Config],
    trajectories: Sequence[Trajectory],
    context: Context,
    method: MarginalLikelihood,
) -> FreeRunModel[Config]:
    """Choose the lags, then fit the hyper-parameters of each output by the evidence.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    c = model.config
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    lags = _choose(records, context, c, method)
    usable(records, lags)
    run = _fit(records, lags, context, c, method, context.log)
    data = segments(records, context, 5000)
    if data is not None:
        context.log(context.ny, float(np.sqrt(simulation_error(run, data))))
    return replace(model, run=run, scaling=scaling)


def _choose(records: ScaledData, context: Context, c: Config, method: MarginalLikelihood) -> Lags:
    """Choose one number for all lags left open, by the simulation error on samples left out."""
    lags = candidate_lags(records, context, LagChoice(c.na, c.nb, c.delay, c.max_order))
    if c.na is not None and c.nb is not None:
        return lags[0]
    part = selection(records, context, c.max_order)
    usable(part, lags[-1])
    few = min(c.points, method.points, 200)
    quick = replace(c, points=few)
    brief = MarginalLikelihood(min(method.iterations, 15), few)
    errors = left_out_error(
        part,
        context,
        lambda kept: [_fit(kept, item, context, quick, brief, lambda *_: None) for item in lags],
        lags[-1].memory,
    )
    return lags[int(np.argmax(errors <= errors.min() + 2 * np.log(1.02)))]


def _fit(
    records: ScaledData,
    lags: Lags,
    context: Context,
    config: Config,
    method: MarginalLikelihood,
    log: Progress,
) -> FreeRun:
    pairs = [regressors(r, lags) for r in records if len(r) > lags.memory]
    z, y, weight = (np.concatenate(each) for each in zip(*pairs, strict=True))
    ny = context.ny
    if config.mean == "hold":
        mean = np.zeros((1 + z.shape[1], ny))
        mean[1 : 1 + ny] = np.eye(ny)
    else:
        # The products of degree one are the constant and each regressor, in order.
        mean = linear_run(records, lags, context, 1e-6, config.margin).one_step.theta
    left = y - mean[0] - z @ mean[1:]
    processes: list[OutputProcess] = []
    for i in range(ny):
        known = np.flatnonzero(weight[:, i] > 0)
        rows = known[spread(len(known), config.points)]
        few = known[spread(len(known), min(config.points, method.points))]
        size = float(left[known, i].std()) or 1.0
        theta, evidence = _hyper(z[few], left[few, i] / size, method)
        log(i, evidence)
        scaled, signal, _, factor = _covariance(z[rows], theta)
        weights = signal * cho_solve((factor, True), left[rows, i])
        processes.append(OutputProcess(scaled, np.exp(theta[:-2]), weights))
    history = fit_history(records, lags, context)
    limits = OutputRange.of(records, config.margin)
    return FreeRun(GaussianPredictor(mean, tuple(processes)), history, limits)


def _distances(a: AnyArray, b: Array) -> AnyArray:
    """Squared distances (len(a), len(b))."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return namespace(a).maximum(squares, 0.0)


def _hyper(x: Array, y: Array, method: MarginalLikelihood) -> tuple[Array, float]:
    """Fit hyper-parameters; y (N,) has unit size.

    Returns:
        Logarithms of the length scales, the signal's and the noise's standard deviation (d + 2,),
        and the negative log evidence a sample.
    """
    d = x.shape[1]
    start = np.concatenate([np.full(d, np.log(2.0 * np.sqrt(d))), [0.0, np.log(0.5)]])
    bounds = [(np.log(0.1), np.log(300.0))] * d
    bounds += [(np.log(1e-2), np.log(1e2)), (np.log(1e-3), np.log(2.0))]
    result = minimize(
        negative_log_evidence,
        start,
        args=(x, y),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": method.iterations},
    )
    return np.asarray(result.x), float(result.fun)


def negative_log_evidence(theta: Array, x: Array, y: Array) -> tuple[float, Array]:
    """Negative log marginal likelihood a sample, and its gradient (d + 2,); theta as `_hyper`
    returns it."""
    n = len(x)
    scaled, signal, kernel, factor = _covariance(x, theta)
    noise = np.exp(2 * theta[-1])
    inverse = cho_solve((factor, True), np.eye(n))
    alpha = inverse @ y
    value = 0.5 * float(y @ alpha) + float(np.log(np.diag(factor)).sum())
    inner = np.outer(alpha, alpha) - inverse
    weighted = inner * kernel
    rows = weighted.sum(axis=1)
    # sum_ij W_ij (x_i - x_j)^2 for symmetric W, for all regressors at once.
    by_length = (rows @ scaled**2) - np.einsum("ij,ij->j", scaled, weighted @ scaled)
    by_signal = float(rows.sum()) + _JITTER * signal * float(np.trace(inner))
    by_noise = noise * float(np.trace(inner))
    gradient = -np.concatenate([by_length, [by_signal, by_noise]])
    return value / n, gradient / n


def _covariance(x: Array, theta: Array) -> tuple[Array, float, Array, Array]:
    """Regressors over their length scales, variance of the signal, covariance of the function at
    the regressors, and Cholesky factor of that of the outputs."""
    scaled = x / np.exp(theta[:-2])
    signal, noise = np.exp(2 * theta[-2]), np.exp(2 * theta[-1])
    kernel = signal * np.exp(-0.5 * _distances(scaled, scaled))
    factor = cholesky(kernel + (noise + _JITTER * signal) * np.eye(len(x)), lower=True)
    return scaled, signal, kernel, factor
