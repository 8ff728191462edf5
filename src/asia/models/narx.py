"""Polynomial NARX model, its terms found by forward orthogonal least squares.

y[k] is a sum of products of y[k-1] .. y[k-na] and u[k-delay] .. u[k-delay-nb+1] up to a degree.
Terms enter in the order of their error reduction ratio; their number is chosen by the simulation
error on segments left out of the fit, because terms that predict one step ahead may not simulate.
Levenberg-Marquardt then takes the coefficients to the least simulation error. In free run outputs
are held within a multiple of the training range. Where outputs were not measured, a first model
gives them and the fit is repeated.
Sources: Chen, Billings and Luo, Int. J. Control 50(5), 1989; Piroddi and Spinelli, Int. J. Control
76(17), 2003 (choice of terms by simulation error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import NamedTuple

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models._config import check_at_least
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import refuse_noise
from asia.models._numerics.gaps import reconstructed
from asia.models._numerics.lags import Lags, OutputRange, fit_history
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.segments import left_out_error, segments, simulation_error
from asia.models._numerics.training_records import ScaledData, check, output_groups, scaled
from asia.models._one_step import (
    RIDGES,
    FreeRunModel,
    LagChoice,
    Polynomial,
    PolynomialRun,
    all_terms,
    build,
    candidate_lags,
    equations,
    refine,
    refinement_samples,
    selection,
    solve,
    usable,
)
from asia.models.methods import LeastSquares

__all__ = ["Config", "build", "train"]

_MOST_PRODUCTS = 1000


@dataclass(frozen=True)
class Config:
    """Lags and terms of the polynomial, and its ridge and range."""

    na: int | None = None
    """Lagged outputs; None chooses among 1..max_order by the simulation error on segments left out
    of the training data, one number for all lags left open."""
    nb: int | None = None
    """Lagged inputs, chosen alike."""
    delay: int | None = 0
    """Samples before the newest input that acts: 0 lets u[k] act on y[k], None chooses among 0..10
    by a linear model."""
    degree: int = 2
    """Greatest degree of the products."""
    terms: int | None = None
    """Terms of each output; None chooses up to max_terms by the simulation error on segments left
    out."""
    max_terms: int = 30
    """Greatest number of terms tried where `terms` is None."""
    max_order: int = 4
    """Greatest number of lags tried where `na` or `nb` is None."""
    margin: float = 0.1
    """Permitted excess of outputs in free run over the training range, as a multiple of its
    width."""
    coefficient_ridge: float = 1e-5
    """Weight of the squared distance of the coefficients from those of least squares, against the
    mean squared error in z-scores, with Levenberg-Marquardt."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "na", "nb", "degree", "terms", "max_terms", "max_order")
        check_at_least(0, self, "delay", "margin", "coefficient_ridge")


def train(
    model: FreeRunModel[Config],
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LeastSquares | LevenbergMarquardt,
) -> FreeRunModel[Config]:
    """Fit lags, terms and coefficients by least squares; with Levenberg-Marquardt refine the
    coefficients.

    Raises:
        UserError: for records too short or mis-shaped.
    """
    c = model.config
    if isinstance(method, LevenbergMarquardt):
        refuse_noise(method, "narx")
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    run, losses = _fitted(records, context, c, method)
    if any((r.counts == 0).any() for r in records):
        records = reconstructed(records, run, context)
        run, losses = _fitted(records, context, c, method, gaps=True)
    for i, loss in enumerate(losses):
        context.log(i, loss)
    return replace(model, run=run, scaling=scaling)


def _fitted(
    records: ScaledData,
    context: Context,
    config: Config,
    method: LeastSquares | LevenbergMarquardt,
    gaps: bool = False,
) -> tuple[PolynomialRun, list[float]]:
    """Fit the model; return its error by iteration too."""
    choice = _choose(records, context, config, method)
    usable(records, choice.lags)
    if gaps and isinstance(method, LevenbergMarquardt):
        choice = _with_more_terms(records, context, config, choice)
    run = _runs(records, context, choice.lags, config, [choice.terms], [choice.ridge])[0]
    data = segments(records, context, refinement_samples(run))
    if data is None:
        return run, []
    if isinstance(method, LevenbergMarquardt):
        return refine(run, data, method, config.coefficient_ridge)
    return run, [float(np.sqrt(simulation_error(run, data)))]


def _with_more_terms(
    records: ScaledData, context: Context, config: Config, choice: _Choice
) -> _Choice:
    """Raise the number of terms to what refined models need.

    Where lags are those of a model, errors one step ahead show little of what is still missing.
    """
    lags, quick = choice.lags, LevenbergMarquardt(iterations=10)
    counts = [n for n in _counts(config) if n >= choice.terms]
    part = selection(records, context, config.max_order)

    def refined(kept: ScaledData) -> list[PolynomialRun]:
        runs = _runs(kept, context, lags, config, counts, [choice.ridge])
        data = [segments(kept, context, refinement_samples(run)) for run in runs]
        return [
            run if d is None else refine(run, d, quick, config.coefficient_ridge)[0]
            for run, d in zip(runs, data, strict=True)
        ]

    errors = left_out_error(part, context, refined, lags.memory)
    if len(errors) != len(counts):
        return choice
    # Few segments do not resolve differences of less than 10 %.
    best = int(np.argmax(errors <= errors.min() + 2 * np.log1p(0.1)))
    return choice._replace(terms=counts[best])


class _Choice(NamedTuple):
    """Settings chosen before the fit, and their log error on samples left out."""

    lags: Lags
    terms: int
    ridge: float
    error: float


def _choose(
    records: ScaledData, context: Context, config: Config, method: LeastSquares | LevenbergMarquardt
) -> _Choice:
    """Choose lags, number of terms and ridge by the simulation error on samples left out."""
    c = config
    lags = candidate_lags(records, context, LagChoice(c.na, c.nb, c.delay, c.max_order))
    ridges: Sequence[float] = (1e-7,)
    if isinstance(method, LeastSquares):
        ridges = RIDGES[::2] if method.ridge is None else (method.ridge,)
    if c.na is not None and c.nb is not None and c.terms is not None and len(ridges) == 1:
        return _Choice(lags[0], c.terms, ridges[0], 0.0)
    part = selection(records, context, c.max_order)
    found = [_choose_terms(part, context, item, c, ridges) for item in lags]
    least = min(choice.error for choice in found)
    return next(choice for choice in found if choice.error <= least + 2 * np.log(1.02))


def _choose_terms(
    records: ScaledData, context: Context, lags: Lags, config: Config, ridges: Sequence[float]
) -> _Choice:
    """Choose number of terms and ridge: the fewest terms within 2 % of the least error."""
    usable(records, lags)
    counts = _counts(config)
    errors = left_out_error(
        records,
        context,
        lambda kept: _runs(kept, context, lags, config, counts, ridges),
        lags.memory,
    )
    table = errors.reshape(len(counts), len(ridges))
    row = int(np.argmax(table.min(axis=1) <= table.min() + 2 * np.log(1.02)))
    column = int(np.argmin(table[row]))
    return _Choice(lags, counts[row], ridges[column], float(table.min()))


def _counts(config: Config) -> list[int]:
    """Numbers of terms to compare, denser where they are few."""
    if config.terms is not None:
        return [config.terms]
    return sorted({round(n) for n in np.geomspace(1, config.max_terms, 14)})


def _runs(
    records: ScaledData,
    context: Context,
    lags: Lags,
    config: Config,
    counts: Sequence[int],
    ridges: Sequence[float],
) -> list[PolynomialRun]:
    """Models with so many terms, for each ridge."""
    size, degree = lags.outputs * context.ny + lags.inputs * context.nu, config.degree
    # Lower the degree until the Gram matrix of the products is cheap.
    while degree > 1 and comb(size + degree, degree) > _MOST_PRODUCTS:
        degree -= 1
    terms = all_terms(size, degree)
    chosen = list[tuple[int, Array, Array, list[int]]]()
    x, y, weight = equations(records, lags, terms)
    for at, outputs in output_groups(weight):
        z = x[at]
        gram, cross = z.T @ z, z.T @ y[at]
        for i in outputs.tolist():
            order = error_reduction_order(gram, cross[:, i], max(counts))
            chosen.append((i, gram, cross[:, i : i + 1], order))
    history, limits = fit_history(records, lags, context), OutputRange.of(records, config.margin)
    found: list[PolynomialRun] = []
    for count in counts:
        for ridge in ridges:
            theta = np.zeros((len(terms), context.ny))
            used = np.zeros(theta.shape, bool)
            for i, gram, side, order in chosen:
                kept = order[:count]
                part = gram[np.ix_(kept, kept)]
                theta[kept, i : i + 1] = solve(part, side[kept], ridge)
                used[kept, i] = True
            rows = used.any(axis=1)
            model = Polynomial(terms[rows], theta[rows], used[rows])
            found.append(PolynomialRun(model, history, limits))
    return found


def error_reduction_order(gram: Array, cross: Array, most: int) -> list[int]:
    """Order of the columns by their reduction of the squared residual, given those before.

    Columns that the chosen ones already span are skipped.

    Args:
        gram: X'X (M, M).
        cross: X'y (M,).
        most: greatest number of columns.
    """
    rest, gain = gram.copy(), cross.copy()
    size = np.diag(gram).copy()
    chosen: list[int] = []
    for _ in range(min(most, len(gram))):
        left = np.diag(rest)
        free = left > 1e-9 * size
        free[chosen] = False
        if not free.any():
            break
        reduction = np.where(free, gain**2 / np.where(free, left, 1.0), -1.0)
        j = int(np.argmax(reduction))
        chosen.append(j)
        pivot = rest[:, j] / rest[j, j]
        gain = gain - pivot * gain[j]
        rest = rest - np.outer(pivot, rest[j])
    return chosen
