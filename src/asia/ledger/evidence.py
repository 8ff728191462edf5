"""Evidence on an experiment besides its score: agreement of folds, noise, findings, parameters."""

import math
import tomllib
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean, variance
from typing import Literal, cast

import numpy as np
from pydantic import TypeAdapter

from asia._statement import NOT_IDENTIFIABLE, UNSETTLED, Statement, stated
from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data.trajectory import Array, Signal
from asia.errors import UserError
from asia.judge.scoring.checks.check import Check, CheckCurve
from asia.judge.scoring.outcome import FoldRecord
from asia.judge.scoring.repeated_fits import significance_threshold
from asia.judge.scoring.residuals import Evidence, PartKind, SignedResidual
from asia.ledger.artifacts import Store
from asia.ledger.events import Variant
from asia.ledger.run import Run
from asia.ledger.view import Experiment, SearchView

# Agreement and disagreement between the folds of one experiment.


LARGEST_SPREAD = 0.5
"""Over the mean of the folds: what lies further apart disagrees."""


@dataclass(frozen=True)
class ParameterSpread:
    """A named parameter in all folds."""

    name: str
    values: tuple[float, ...]

    @property
    def spread(self) -> float:
        """Largest less smallest value over the size of their mean."""
        mean = abs(fmean(self.values))
        apart = max(self.values) - min(self.values)
        if mean > 0:
            return apart / mean
        return float("inf") if apart > 0 else 0.0

    @property
    def changes_sign(self) -> bool:
        """Return whether the folds disagree on the sign."""
        return min(self.values) < 0 < max(self.values)

    @property
    def disagrees(self) -> bool:
        """Return whether the folds found significantly different values."""
        return self.changes_sign or self.spread > LARGEST_SPREAD


def parameter_spreads(folds: Sequence[FoldRecord]) -> tuple[ParameterSpread, ...]:
    """Return the spread of each parameter that all folds name, largest disagreement first."""
    tables = [dict(one.parameters) for one in folds]
    names = [n for n in (tables[0] if tables else {}) if all(n in table for table in tables)]
    found = [ParameterSpread(name, tuple(table[name] for table in tables)) for name in names]
    return tuple(sorted(found, key=lambda one: -one.spread))


@dataclass(frozen=True)
class SharedResidual:
    """The mean residual over one part of the data, in all folds together."""

    residual: SignedResidual
    """Its mean over the folds that have this part, with the standard error of that mean; share and
    gain are means over all folds."""
    folds: tuple[int, ...]
    """The folds whose own mean lies on the same side by more than its standard error, from 1."""


def shared_residuals(folds: Sequence[Sequence[SignedResidual]]) -> tuple[SharedResidual, ...]:
    """Return the signed residuals that exceed the noise in all folds together.

    Significant residuals come before those that may be chance, then the largest gain first.
    """
    found: defaultdict[tuple[int, PartKind, int, int], list[tuple[int, SignedResidual]]]
    found = defaultdict(list)
    for number, fold in enumerate(folds, 1):
        for one in fold:
            found[one.output, one.kind, one.signal, one.part].append((number, one))
    shared: list[SharedResidual] = []
    for ones in found.values():
        mean = fmean(one.mean for _, one in ones)
        residual = replace(
            ones[0][1],
            mean=mean,
            error=math.sqrt(sum(one.error**2 for _, one in ones)) / len(ones),
            share=sum(one.share for _, one in ones) / len(folds),
            gain=sum(one.gain for _, one in ones) / len(folds),
        )
        agree = (number for number, one in ones if one.mean * mean > abs(mean) * one.error)
        if residual.evidence is not Evidence.NONE:
            shared.append(SharedResidual(residual, tuple(agree)))
    return tuple(
        sorted(
            shared, key=lambda one: (one.residual.evidence is Evidence.CHANCE, -one.residual.gain)
        )
    )


# Curves of the validation checks, as an artifact of a run.


@dataclass(frozen=True)
class DrawnCurve:
    """One line to draw."""

    name: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    band: float | None = None
    """Half the width of a band around zero that chance stays within; None without one."""


@dataclass(frozen=True)
class DrawnCheck:
    """Drawing of one check."""

    name: str
    axes: tuple[str, str]
    curves: tuple[DrawnCurve, ...]
    left_out: int = 0
    """Curves beyond those."""


_DRAWN: TypeAdapter[tuple[DrawnCheck, ...]] = TypeAdapter(tuple[DrawnCheck, ...])

# More curves of a check cannot be distinguished in a drawing.
_MOST_CURVES = 5
# A long curve is drawn by its minimum and maximum in each of these columns.
_COLUMNS = 120


def put_curves(store: Store, checks: Sequence[Check]) -> str:
    """Keep the first curves of each check, thinned; the name of the artifact."""
    drawn = tuple(
        DrawnCheck(
            one.name,
            one.axes,
            tuple(map(_drawn, one.curves[:_MOST_CURVES])),
            max(0, len(one.curves) - _MOST_CURVES),
        )
        for one in checks
        if one.curves
    )
    return store.put(_DRAWN.dump_json(drawn))


def _drawn(curve: CheckCurve) -> DrawnCurve:
    whole = np.isfinite(curve.x) & np.isfinite(curve.y)
    x, y = curve.x[whole], curve.y[whole]
    if len(y) > 2 * _COLUMNS:
        columns = np.array_split(np.arange(len(y)), _COLUMNS)
        lowest = [part[np.argmin(y[part])] for part in columns]
        highest = [part[np.argmax(y[part])] for part in columns]
        kept = np.unique(lowest + highest)
        x, y = x[kept], y[kept]
    return DrawnCurve(curve.name, _rounded(x), _rounded(y), curve.band)


def _rounded(values: Array) -> tuple[float, ...]:
    return tuple(float(f"{value:.5g}") for value in values.tolist())


def get_curves(store: Store, name: str) -> tuple[DrawnCheck, ...]:
    """Those of an artifact. Raises UserError where it is missing or this version cannot read it."""
    return store.parse(name, _DRAWN)


def folds_of(store: Store, experiment: Experiment) -> tuple[FoldRecord, ...]:
    """Return the whole record of each fold; () where a fold failed.

    Held-out errors are left out if the experiment has no score: an agent must not learn the degree
    to which a candidate was found suspect.
    """
    found = [fold.loaded(store) for fold in experiment.folds]
    if experiment.score is None:
        found = [replace(one, errors=(), steps=(), held_out_residuals=()) for one in found]
    return tuple(found)


def noise_of_repeats(view: SearchView, among: Collection[int] = ()) -> float | None:
    """Return the standard deviation of V over fits of the same source, pooled over all sources that
    were fitted repeatedly; None if no source was.

    Args:
        among: experiments of interest. If one of these was repeated, the others do not count,
            because a family far above them in V has another variance.
    """
    for chosen in ([e for e in view.finished if e.number in among], view.finished):
        values: defaultdict[str, list[float]] = defaultdict(list)
        for e in chosen:
            if e.score is not None and e.result is not None and e.result.duplicate_of is None:
                values[e.proposed.digest] += e.seed_values
        repeated = [one for one in values.values() if len(one) > 1]
        if repeated:
            degrees = sum(len(one) - 1 for one in repeated)
            return math.sqrt(sum((len(one) - 1) * variance(one) for one in repeated) / degrees)
    return None


def incumbent_threshold(view: SearchView) -> float | None:
    """Return the improvement of the mean over seeds that a candidate with the same variance needs
    to be kept; 0 if the incumbent does not depend on the seed, None if that is not known or one fit
    decides.
    """
    held = view.incumbent
    if held is None or held.result is None or not held.result.retests:
        return None
    return significance_threshold(held.seed_values, held.seed_values)


# Evidence on one experiment besides its score.


@dataclass(frozen=True)
class RunSettings:
    """Limits and settings that the figures of an experiment are compared with."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    fit_seconds: float
    """Time limit of the fit of a fold, s."""
    memory_mb: int
    """The largest address space of a worker."""


@dataclass(frozen=True)
class ComparedScore:
    """Difference of V to that of another experiment."""

    experiment: int
    """The other one."""
    role: str
    """`parent`, `previous best` or `parent and previous best`."""
    value: float
    """V of this one less V of the other."""
    share: float
    """`value` over V of the other."""


@dataclass(frozen=True)
class ExperimentEvidence:
    """Evidence on one experiment besides its score."""

    setting: RunSettings
    folds: tuple[FoldRecord, ...]
    """Its folds, whole; () for a failure."""
    held_out: tuple[str, ...]
    """Description of the held-out part of each fold; "" in older ledgers."""
    values: tuple[float | None, ...]
    """V of each fold; None where it is not reported."""
    residuals: tuple[SharedResidual, ...]
    """Ranges in which it is too high or too low on the training records, largest first."""
    held_out_residuals: tuple[SharedResidual, ...]
    """The same on the held-out parts; () unless the protocol shows them."""
    parameters: tuple[ParameterSpread, ...]
    """Named parameters, those on which the folds agree least first."""
    differences: tuple[ComparedScore, ...]
    noise: float | None
    """The standard deviation of V over repeats, of the experiments in `differences` and this one
    where they were repeated; None where it was not measured."""
    printed: str
    """Output of a failed fit; "" if there are folds."""
    failed_fold: str
    """The fold that failed, in words; "" where none did, and in older ledgers."""
    variants: tuple[Variant, ...] = ()
    """Variants that were compared before it was scored."""

    @property
    def recorded(self) -> bool:
        """Return whether the ledger holds findings, which older ledgers lack."""
        return bool(self.printed or self.failed_fold or any(one.findings for one in self.folds))


def settings_of_run(directory: Path) -> RunSettings:
    """The settings in the lock file of a run. Raises UserError when it cannot be read."""
    path = directory / "problem.lock.toml"
    try:
        lock = tomllib.loads(path.read_text("utf-8"))
        inputs, outputs = (
            tuple(Signal(s["name"], s.get("unit", "")) for s in lock[key])
            for key in ("inputs", "outputs")
        )
        budget = lock["budget"]
        return RunSettings(inputs, outputs, float(budget["fit_seconds"]), int(budget["memory_mb"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}): the signals of the run are not known"
        ) from None


def evidence_of(
    experiment: Experiment, view: SearchView, store: Store, setting: RunSettings
) -> ExperimentEvidence:
    """Collect the evidence on an experiment that has a result."""
    result, score, fold_names = experiment.result, experiment.score, view.started.folds
    assert result is not None
    folds = folds_of(store, experiment)
    count = len(folds)
    differences = compared_scores(experiment, view)
    noise = noise_of_repeats(view, {experiment.number, *(one.experiment for one in differences)})
    printed, failed_fold = "", ""
    if result.output is not None and not folds:
        printed = store.text(result.output)
    failed = experiment.failure.fold if experiment.failure else None
    if failed and failed <= len(fold_names):
        failed_fold = f"fold {failed}, {fold_names[failed - 1]}"
    return ExperimentEvidence(
        setting=setting,
        folds=folds,
        held_out=(fold_names or ("",) * count) if folds else (),
        values=tuple(f.value for f in score.folds) if score and score.folds else (None,) * count,
        residuals=shared_residuals([one.residuals for one in folds]),
        held_out_residuals=shared_residuals([one.held_out_residuals for one in folds]),
        parameters=parameter_spreads(folds),
        differences=differences,
        noise=noise,
        printed=printed,
        failed_fold=failed_fold,
        variants=result.variants,
    )


def compared_scores(experiment: Experiment, view: SearchView) -> tuple[ComparedScore, ...]:
    """V of an experiment less that of its parent and of the best one before; () without a score."""
    if experiment.score is None:
        return ()
    value, parent = experiment.score.value, experiment.proposed.parent
    before = next((e for e in reversed(view.bests) if e.number < experiment.number), None)
    others: list[tuple[str, Experiment]] = []
    if before is not None and parent == before.number:
        others.append(("parent and previous best", before))
    else:
        if parent is not None and parent != experiment.number:
            others.append(("parent", view.experiment(parent)))
        if before is not None:
            others.append(("previous best", before))
    return tuple(
        ComparedScore(
            e.number, role, value - e.score.value, (value - e.score.value) / e.score.value
        )
        for role, e in others
        if e.score is not None and e.score.value > 0
    )


# Identified parameters of the best candidate with their uncertainty.


LEAST_SHARE = 0.5
"""Share of the information that must come from the records to determine a parameter."""
FITTED = "fitted to all training records"
STRONG = 0.95
"""Parameters whose errors are correlated more than this are known together only."""
DISAGREEMENT = 3.0
"""Standard error by the folds over that by noise, from which on the fold models disagree."""
FOLD_QUANTILE = 1.96
"""Half the width of the interval by the folds, in their standard errors. Student's t would treat
the folds as a random sample; they exhaust the record, and the interval is for the mean over it."""


@dataclass(frozen=True)
class EstimatedParameter:
    """A parameter of the model that was fitted to all training records."""

    name: str
    unit: str
    value: float
    standard_error: float | None
    """Standard error in this unit; None if the records do not determine the parameter."""
    low: float | None
    """Lower end of the 95 % interval; None where it is open."""
    high: float | None
    lower: float | None
    """The least value of its search range; None where it is open."""
    upper: float | None
    data_share: float
    """The part of what is known of it that the records give, from 0 to 1."""
    misfit_error: float = 0.0
    """Possible bias by a missing effect; 0 if the residuals show none, and in older ledgers."""

    @property
    def identifiable(self) -> bool:
        """Return whether the records say more of it than its prior and its search range."""
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
        return "lower" if place < 0.005 else "upper" if place > 0.995 else ""


@dataclass(frozen=True)
class EstimatedModel:
    """Estimated parameters of one model."""

    parameters: tuple[EstimatedParameter, ...]
    correlation: tuple[tuple[float | None, ...], ...]
    """Correlation matrix of the errors; None for unknown entries."""
    equations: tuple[str, ...]
    """The model's equations with numbers in them, one a line; () where it gives none."""
    library: bool = False
    """True if the candidate has no code of its own besides calls of ASIA's model library. Otherwise
    names, values and equations are the candidate's claims."""
    reason: str = ""
    """Why there are no standard errors; "" where there are, and in older ledgers."""
    source: str = FITTED
    """Where the values are from, in a few words."""


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
    def is_count(self) -> bool:
        """Whether it counts states or samples, so that it has a range but no standard error."""
        return self.fitted.name.partition(" [")[0] in ("order", "delay")

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval to quote: the widest of those by noise, by the folds, and by a missing
        effect; None where it is withheld."""
        return self.statement.interval

    @property
    def statement(self) -> Statement:
        """The value with its interval, or why that is withheld."""
        one = self.fitted
        ends = None
        if one.low is not None and one.high is not None:
            wide = max(self._by_folds, one.misfit_error)
            ends = interval_ends(one.value, one.low, one.high, one.lower, wide)
        unknown = one.standard_error is not None and not one.identifiable
        state = partial(
            stated, one.value, unit=one.unit, reason=NOT_IDENTIFIABLE if unknown else "",
            at_bound=one.at_bound, positive=one.lower is not None and one.lower > 0.0,
        )  # fmt: skip
        found = state(ends)
        if ends is not None and found.interval is None:
            by_noise = one.low, one.high
            if None not in by_noise and state(cast("tuple[float, float]", by_noise)).interval:
                return replace(found, reason=UNSETTLED)
        return found

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
    """The wider of low to high and value -+ wide; logarithmic for a positive range."""
    if lower is not None and lower > 0 and value > 0:
        ratio = math.exp(min(wide / value, 700.0))
        return min(low, value / ratio), max(high, value * ratio)
    return min(low, value - wide), max(high, value + wide)


def with_fold_values(
    fitted: EstimatedModel, tables: Sequence[Mapping[str, float]], *, jackknife: bool = True
) -> tuple[IdentifiedParameter, ...]:
    """Combine parameters with their values in the fold models.

    Args:
        tables: one table of values by name a fold.
        jackknife: false if the folds do not each leave out another part of the records.
    """
    rows: list[IdentifiedParameter] = []
    for one in fitted.parameters:
        known = all(one.name in table for table in tables)
        values = tuple(table[one.name] for table in tables) if known else ()
        error = jackknife_error(one.value, values) if jackknife and len(values) > 1 else None
        rows.append(IdentifiedParameter(one, values, error))
    return tuple(rows)


def jackknife_error(value: float, folds: Sequence[float]) -> float:
    """The standard error of a value by what it is without each of the folds."""
    return math.sqrt((len(folds) - 1) / len(folds) * sum((one - value) ** 2 for one in folds))


@dataclass(frozen=True)
class IdentifiedModel:
    """Model that a search identified."""

    experiment: int
    """The best candidate."""
    parameters: tuple[IdentifiedParameter, ...]
    correlation: tuple[tuple[float | None, ...], ...]
    equations: tuple[str, ...]
    library: bool = False
    """As in `EstimatedModel`."""
    reason: str = ""
    """As in `EstimatedModel`."""
    source: str = FITTED
    """As in `EstimatedModel`."""
    fit: float | None = None
    """Fit of the best candidate in percent."""

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


def fold_estimates(tables: Sequence[Mapping[str, float]], fold: int = 0) -> EstimatedModel | None:
    """Parameters of a model without a refit: means over its fold models, with their scatter as
    error and no interval: few folds carry none, and do not show a missing effect. None where the
    fold models do not name the same ones, or there is only one.

    Args:
        tables: as in `with_fold_values`
        fold: the fold, 1-based, whose model is used: its values in place of the means
    """
    names = [name for name in (tables[0] if tables else {}) if all(name in t for t in tables)]
    if len(tables) < 2 or not names:
        return None
    found: list[EstimatedParameter] = []
    for name in names:
        values = [table[name] for table in tables]
        value = math.fsum(values) / len(values)
        error = jackknife_error(value, values)
        value = values[fold - 1] if fold else value
        found.append(EstimatedParameter(name, "", value, error, None, None, None, None, 1.0))
    own = f"of the model of fold {fold}" if fold else "mean over the fold models"
    source = (
        f"{own} with the scatter of the fold models as error, because there is no refit; the "
        f"scatter of {len(tables)} fold models carries no interval"
    )
    return EstimatedModel(tuple(found), (), (), source=source)


def put_estimates(
    store: Store, estimates: ParameterEstimates | EstimatedModel, *, library: bool = False
) -> str:
    """Store estimates and return the name of the artifact. library: as in `EstimatedModel`."""
    model = estimates if isinstance(estimates, EstimatedModel) else estimated(estimates)
    return store.put(_FITTED.dump_json(replace(model, library=library)))


def get_estimates(store: Store, name: str) -> EstimatedModel:
    """Those of an artifact. Raises UserError where it is missing or this version cannot read it."""
    return store.parse(name, _FITTED)


def identified(run: Run) -> IdentifiedModel | None:
    """The identified parameters of the best candidate; None if there are none, and in older
    ledgers."""
    refitted = run.view.refitted
    if refitted is None or refitted.estimates is None or not run.store.kept:
        return None
    fitted = get_estimates(run.store, refitted.estimates)
    return _beside_folds(run, run.view.experiment(refitted.experiment), fitted)


def identified_by_folds(
    run: Run, experiment: Experiment, *, library: bool
) -> IdentifiedModel | None:
    """The parameters of an experiment that was not refitted, by its fold models; None without them.

    Args:
        library: as in `EstimatedModel`
    """
    fitted = fold_estimates(_fold_tables(run, experiment)) if run.store.kept else None
    fitted = fitted and replace(fitted, library=library)
    return fitted and _beside_folds(run, experiment, fitted)


def _fold_tables(run: Run, experiment: Experiment) -> list[Mapping[str, float]]:
    return [dict(one.parameters) for one in folds_of(run.store, experiment)]


def _beside_folds(run: Run, experiment: Experiment, fitted: EstimatedModel) -> IdentifiedModel:
    try:
        lock = tomllib.loads((run.directory / "problem.lock.toml").read_text("utf-8"))
        one_sided = lock["protocol"]["folds"]["kind"] in ("forward", "tail")
    except (OSError, ValueError, KeyError, TypeError):
        one_sided = False
    rows = with_fold_values(fitted, _fold_tables(run, experiment), jackknife=not one_sided)
    return IdentifiedModel(
        experiment.number, rows, fitted.correlation, fitted.equations, fitted.library,
        fitted.reason, fitted.source, experiment.fit,
    )  # fmt: skip


def estimated(estimates: ParameterEstimates) -> EstimatedModel:
    """Estimates of a candidate with what is infinite left open."""
    return EstimatedModel(
        tuple(map(_estimated_parameter, estimates.parameters)),
        tuple(tuple(map(_finite, row)) for row in estimates.correlation.tolist()),
        estimates.equations,
        reason=estimates.reason,
    )


def _estimated_parameter(one: ParameterEstimate) -> EstimatedParameter:
    error = _finite(one.standard_error)
    return EstimatedParameter(
        name=one.name,
        unit=one.unit,
        value=one.value,
        standard_error=error,
        low=None if error is None else _finite(one.low),
        high=None if error is None else _finite(one.high),
        lower=_finite(one.lower),
        upper=_finite(one.upper),
        data_share=_finite(one.data_share) or 0.0,
        misfit_error=max(_finite(one.misfit_error) or 0.0, 0.0),
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
