"""Identified parameters of the winner with their uncertainty."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.errors import UserError
from asia.ledger._run import Run
from asia.ledger._store import Store
from asia.ledger.evidence.findings import findings_of

LEAST_SHARE = 0.5
"""Minimum share of the information on a parameter that must come from the records; with less, the
records do not determine it.
"""
STRONG = 0.95
"""Parameters whose errors are correlated more than this are known together only."""
# Distance to a bound, as a share of the range, below which a parameter is at the bound.
_AT_END = 0.005
DISAGREEMENT = 3.0
"""Standard error by the folds over that by noise, from which on the fold models disagree."""
FOLD_QUANTILE = 1.96
"""Half the width of the interval by the folds, in their standard errors. Student's t would treat
the folds as a random sample; they exhaust the record, and the interval is for the mean over it."""
_ONE_SIDED = ("forward", "tail")


@dataclass(frozen=True)
class EstimatedParameter:
    """A parameter of the model that was fitted to all training records."""

    name: str
    """The model's word."""
    unit: str
    """Its unit; "" where none is given."""
    value: float
    """Value in this unit."""
    standard_error: float | None
    """Standard error in this unit; None if the records do not determine the parameter."""
    low: float | None
    """Lower end of the 95 % interval; None where it is open."""
    high: float | None
    """Upper end."""
    lower: float | None
    """The least value of its search range; None where it is open."""
    upper: float | None
    """The greatest one."""
    data_share: float
    """The part of what is known of it that the records give, from 0 to 1."""
    misfit_error: float = 0.0
    """Possible bias by a missing effect, in this unit; 0 if the residuals show none, and in older
    ledgers.
    """

    @property
    def identifiable(self) -> bool:
        """Return whether the records determine the parameter better than its prior and its search
        range do.
        """
        if self.standard_error is None or self.data_share < LEAST_SHARE:
            return False
        ends = (self.low, self.high, self.lower, self.upper)
        if any(end is None for end in ends):
            return True
        low, high, lower, upper = (end for end in ends if end is not None)
        return low > lower or high < upper

    @property
    def at_bound(self) -> str:
        """`lower` or `upper` where it sits at this end of its range, or beyond it; else ""."""
        lower, upper, value = self.lower, self.upper, self.value
        if lower is None or upper is None:
            return ""
        if lower > 0:
            if value <= 0:
                return "lower"
            lower, upper, value = math.log(lower), math.log(upper), math.log(value)
        place = (value - lower) / (upper - lower) if upper > lower else 0.5
        return "lower" if place < _AT_END else "upper" if place > 1.0 - _AT_END else ""


@dataclass(frozen=True)
class EstimatedModel:
    """Estimated parameters of one model."""

    parameters: tuple[EstimatedParameter, ...]
    """Parameters in the order of the model."""
    correlation: tuple[tuple[float | None, ...], ...]
    """Correlation matrix of the errors; None for unknown entries."""
    equations: tuple[str, ...]
    """The model's equations with numbers in them, one a line; () where it gives none."""


@dataclass(frozen=True)
class IdentifiedParameter:
    """Parameter with its values in the fold models."""

    fitted: EstimatedParameter
    """Estimate from all training records."""
    folds: tuple[float, ...]
    """Its value in each fold model; () where these do not name it."""
    fold_error: float | None
    """Its standard error by the spread of the fold models around the fitted value (delete-a-group
    jackknife: Kott, Journal of Official Statistics 17(4), 2001); None where folds train on the past
    alone."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval to quote: the widest of those by noise, by the folds, and by a missing
        effect; None where it is open."""
        low, high = self.fitted.low, self.fitted.high
        if low is None or high is None:
            return None
        wide = max(self._by_folds, self.fitted.misfit_error)
        return interval_ends(self.fitted.value, low, high, self.fitted.lower, wide)

    @property
    def decided_by(self) -> Literal["noise", "folds", "missing effect"]:
        """The source of the interval to quote."""
        low, high = self.fitted.low, self.fitted.high
        if self.interval is None or self.interval == (low, high):
            return "noise"
        return "folds" if self._by_folds >= self.fitted.misfit_error else "missing effect"

    @property
    def disagrees(self) -> bool:
        """Return whether the fold models differ by more than noise explains."""
        error, spread = self.fitted.standard_error, self.fold_error
        return error is not None and spread is not None and spread > DISAGREEMENT * error

    @property
    def _by_folds(self) -> float:
        return FOLD_QUANTILE * (self.fold_error or 0.0)


def interval_ends(
    value: float, low: float, high: float, lower: float | None, wide: float
) -> tuple[float, float]:
    """The wider of low to high and value -+ wide; on the logarithmic scale where the parameter has
    a positive range."""
    if lower is not None and lower > 0 and value > 0:
        ratio = math.exp(min(wide / value, 700.0))
        return min(low, value / ratio), max(high, value * ratio)
    return min(low, value - wide), max(high, value + wide)


def beside_folds(
    fitted: EstimatedModel, tables: Sequence[Mapping[str, float]], *, jackknife: bool = True
) -> tuple[IdentifiedParameter, ...]:
    """Combine parameters with their values in the fold models.

    Args:
        fitted: estimates from all training records.
        tables: one table of values by name a fold.
        jackknife: false if the folds do not each leave out another part of the records.
    """
    rows: list[IdentifiedParameter] = []
    for one in fitted.parameters:
        known = bool(tables) and all(one.name in table for table in tables)
        values = tuple(table[one.name] for table in tables) if known else ()
        spread = jackknife_error(one.value, values) if jackknife and len(values) > 1 else None
        rows.append(IdentifiedParameter(one, values, spread))
    return tuple(rows)


def jackknife_error(value: float, folds: Sequence[float]) -> float:
    """The standard error of a value by what it is without each of the folds."""
    return math.sqrt((len(folds) - 1) / len(folds) * sum((one - value) ** 2 for one in folds))


@dataclass(frozen=True)
class IdentifiedModel:
    """Model that a search identified."""

    experiment: int
    """The winner."""
    parameters: tuple[IdentifiedParameter, ...]
    """Parameters in the order of the model."""
    correlation: tuple[tuple[float | None, ...], ...]
    """Correlation matrix of the errors."""
    equations: tuple[str, ...]
    """Equations with their numerical values."""

    @property
    def disagreeing(self) -> tuple[str, ...]:
        """Names of the parameters on which the fold models disagree."""
        return tuple(one.fitted.name for one in self.parameters if one.disagrees)

    @property
    def entangled(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters whose errors are strongly correlated, the strongest first."""
        names = [one.fitted.name for one in self.parameters]
        found = [
            (names[i], names[j], rho)
            for i, row in enumerate(self.correlation)
            for j, rho in enumerate(row[:i])
            if rho is not None and abs(rho) > STRONG
        ]
        return tuple(sorted(found, key=lambda pair: -abs(pair[2])))


_FITTED: TypeAdapter[EstimatedModel] = TypeAdapter(EstimatedModel)


def put_estimates(store: Store, estimates: ParameterEstimates) -> str:
    """Keep them; the name of the artifact."""
    return store.put(_FITTED.dump_json(estimated(estimates)))


def get_estimates(store: Store, name: str) -> EstimatedModel:
    """Those of an artifact. Raises UserError where it is missing or this version cannot read it."""
    try:
        return _FITTED.validate_json(store.get(name))
    except ValidationError:
        raise UserError(
            f"artifact {name} was written by another version of ASIA: read it with that one"
        ) from None


def identified(run: Run) -> IdentifiedModel | None:
    """Return the identified parameters of the winner of a run; None if it reports none, without a
    winner, and in older ledgers.
    """
    refitted = run.view.refitted
    if refitted is None or refitted.estimates is None or not run.store.kept:
        return None
    fitted = get_estimates(run.store, refitted.estimates)
    findings = findings_of(run.store, run.view.experiment(refitted.experiment), bounded=False)
    tables = [dict(one.parameters) for one in findings]
    jackknife = _folds_kind(run.directory) not in _ONE_SIDED
    rows = beside_folds(fitted, tables, jackknife=jackknife)
    return IdentifiedModel(refitted.experiment, rows, fitted.correlation, fitted.equations)


def estimated(estimates: ParameterEstimates) -> EstimatedModel:
    """Estimates of a candidate with what is infinite left open."""
    return EstimatedModel(
        tuple(_fitted(one) for one in estimates.parameters),
        tuple(tuple(map(_finite, row)) for row in estimates.correlation.tolist()),
        estimates.equations,
    )


def _fitted(one: ParameterEstimate) -> EstimatedParameter:
    error, low, high, lower, upper = map(
        _finite, (one.standard_error, one.low, one.high, one.lower, one.upper)
    )
    share = one.data_share if math.isfinite(one.data_share) else 0.0
    if error is None:
        low, high = None, None
    misfit = one.misfit_error if math.isfinite(one.misfit_error) else 0.0
    return EstimatedParameter(
        one.name, one.unit, one.value, error, low, high, lower, upper, share, max(misfit, 0.0)
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _folds_kind(directory: Path) -> str:
    """ "" where the lock file does not say."""
    try:
        lock = tomllib.loads((directory / "problem.lock.toml").read_text("utf-8"))
        return str(lock["protocol"]["folds"]["kind"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
