"""Common parts of the families that predict one step ahead and are used in free run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Generic, TypeVar

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.errors import UserError
from asia.models._arrays import AnyArray
from asia.models._data.lags import FreeRun, Lags, OutputRange, fit_history
from asia.models._data.records import ScaledData, ScaledTrajectory, past_length, shortened
from asia.models._data.scaling import Scaling
from asia.models._data.stretches import left_out_error
from asia.models._one_step.polynomial import Polynomial, PolynomialRun, all_terms, equations, solve

C = TypeVar("C")

RIDGES = (1e-9, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2)
# Samples for choices of lags, which take hundreds of fits; this many distinguish candidates.
_SELECTION_SAMPLES = 6000


@dataclass(frozen=True)
class FreeRunModel(Generic[C]):
    """Input-output model used in free run."""

    config: C
    """Settings of the family."""
    run: FreeRun | None = None
    """Model in free run; None before training."""
    scaling: Scaling | None = None
    """Scaling from physical units to z-scores; None before training."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in physical units.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny).

        Raises:
            UserError: before training.
        """
        run, s = self._trained()
        return s.physical(run(s.inputs(past_u), s.outputs(past_y), s.inputs(u)))

    def initial(self, past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        """Initial state, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        run, s = self._trained()
        return run.initial(s.inputs(past_u), s.outputs(past_y), s.inputs(u))

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """Advance by one sample, see `asia.candidate.StepModel`.

        Raises:
            UserError: before training.
        """
        run, s = self._trained()
        state, y = run.step(state, s.inputs(u))
        return state, s.physical(y)

    def _trained(self) -> tuple[FreeRun, Scaling]:
        if self.run is None or self.scaling is None:
            raise UserError("input-output model: not trained yet; call train first")
        return self.run, self.scaling


@dataclass(frozen=True)
class LagChoice:
    """Lags and delay, or limits of their choice: the fewest parameters within the tolerance of the
    best."""

    outputs: int | None
    """Number of lagged outputs; None: chosen from 1..max_order."""
    inputs: int | None
    """Number of lagged inputs; None: chosen from 1..max_order."""
    delay: int | None
    """Delay in samples; None: chosen from 0..max_delay."""
    max_order: int
    """Greatest number of lags tried."""
    max_delay: int = 10
    """Greatest delay tried."""
    tolerance: float = 0.03
    """Relative tolerance of the root mean squared error."""


def linear_run(
    records: ScaledData, lags: Lags, context: Context, ridge: float, margin: float
) -> PolynomialRun:
    """Fit an ARX model by ridge regression, limited to the training range widened by `margin`
    times."""
    ny, nu = records[0].y.shape[1], records[0].u.shape[1]
    terms = all_terms(lags.outputs * ny + lags.inputs * nu, 1)
    x, y = equations(records, lags, terms)
    theta = solve(x.T @ x, x.T @ y, ridge)
    model = Polynomial(terms, theta, np.ones(theta.shape, bool))
    return PolynomialRun(
        model, fit_history(records, lags, context), OutputRange.of(records, margin)
    )


def choose_lags(records: ScaledData, context: Context, choice: LagChoice) -> Lags:
    """Choose the lags of a linear model by its simulation error on samples left out of the fit."""
    part = selection(records, context, choice.max_order)
    highest = max(1, min(choice.max_order, min(len(r) for r in part) // 12))
    delay = choice.delay
    if delay is None:
        few = [Lags(min(2, highest), min(2, highest), d) for d in range(choice.max_delay + 1)]
        delay = _best(few, _errors(part, context, few), 0.01).delay
    counts = range(1, highest + 1)
    numbers = product(
        counts if choice.outputs is None else (choice.outputs,),
        counts if choice.inputs is None else (choice.inputs,),
    )
    lags = [Lags(a, b, delay) for a, b in numbers]
    if len(lags) == 1:
        return lags[0]
    ny, nu = context.ny, context.nu
    lags.sort(key=lambda item: item.outputs * ny + item.inputs * nu)
    return _best(lags, _errors(part, context, lags), choice.tolerance)


def selection(records: ScaledData, context: Context, max_order: int) -> list[ScaledTrajectory]:
    """Records for choices: parts long enough to leave something to simulate."""
    shortest = 3 * (past_length(context) + (context.horizon or 0)) + 12 * max_order
    return shortened(
        [r for r in records if len(r) > past_length(context)], _SELECTION_SAMPLES, shortest
    )


def choose_ridge(
    records: ScaledData,
    context: Context,
    fit: Callable[[ScaledData, float], FreeRun],
    shortest: int,
) -> float:
    """Choose the ridge with the least simulation error on samples left out of the fit."""
    errors = left_out_error(
        records, context, lambda kept: [fit(kept, ridge) for ridge in RIDGES], shortest
    )
    return RIDGES[int(np.argmin(errors))]


def usable(records: ScaledData, lags: Lags) -> None:
    """Check that a record is long enough for the lags.

    Raises:
        UserError: if none is.
    """
    if all(len(r) <= lags.memory for r in records):
        raise UserError(
            f"training records: the longest has {max(len(r) for r in records)} samples, the model "
            f"needs {lags.memory} before the first it can predict; use fewer lags"
        )


def _errors(records: ScaledData, context: Context, lags: Sequence[Lags]) -> Array:
    usable(records, max(lags, key=lambda item: item.memory))
    shortest = 2 * past_length(context) + 4 * max(item.memory for item in lags)
    return left_out_error(
        records,
        context,
        lambda kept: [linear_run(kept, item, context, 1e-7, 10.0) for item in lags],
        shortest,
    )


def _best(lags: Sequence[Lags], errors: Array, tolerance: float) -> Lags:
    limit = errors.min() + 2 * np.log1p(tolerance)
    return lags[int(np.argmax(errors <= limit))]
