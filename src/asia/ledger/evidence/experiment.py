"""Evidence on one experiment besides its score."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from asia.data import Signal
from asia.errors import UserError
from asia.evaluation import FoldFindings
from asia.ledger._store import Store
from asia.ledger._view import Experiment, SearchView
from asia.ledger.evidence.agreement import (
    ParameterSpread,
    SharedResidual,
    parameter_spreads,
    shared_residuals,
)
from asia.ledger.evidence.findings import findings_of
from asia.ledger.evidence.noise import noise_of_repeats
from asia.scoring import Diagnostics


@dataclass(frozen=True)
class RunSettings:
    """Limits and settings that the figures of an experiment are compared with."""

    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    fit_seconds: float
    """Time limit of the fit of a fold, s."""
    memory_mb: int
    """The largest address space of a worker."""


@dataclass(frozen=True)
class FoldShown:
    """Evidence on one fold of an experiment."""

    held_out: str
    """Description of the held-out part; "" in older ledgers."""
    value: float | None
    """V of the fold; None where it is not reported."""
    diagnostics: Diagnostics
    """Residual analysis of the training simulation."""
    fit_seconds: float
    """Duration of the fit."""
    findings: FoldFindings | None
    """Further findings; None in older ledgers."""


@dataclass(frozen=True)
class ComparedScore:
    """Difference of V to that of another experiment."""

    experiment: int
    """The other one."""
    role: str
    """`parent`, `best before` or `parent and best before`."""
    value: float
    """V of this one less V of the other."""
    share: float
    """`value` over V of the other."""


@dataclass(frozen=True)
class ExperimentEvidence:
    """Evidence on one experiment besides its score."""

    setting: RunSettings
    """Settings that the figures are compared with."""
    folds: tuple[FoldShown, ...]
    """Its folds; () for a failure."""
    residuals: tuple[SharedResidual, ...]
    """Operating ranges in which the model is too high or too low on the training records, most
    important first.
    """
    held_out_residuals: tuple[SharedResidual, ...]
    """The same on the held-out parts; () unless the protocol shows them."""
    parameters: tuple[ParameterSpread, ...]
    """Named parameters, those on which the folds agree least first."""
    differences: tuple[ComparedScore, ...]
    """Differences of V to the parent and to the best before it."""
    noise: float | None
    """The standard deviation of V over repeats, of the experiments in `differences` and this one
    where they were repeated; None where it was not measured."""
    printed: str
    """Output of a failed fit; "" if there are folds."""
    failed_fold: str
    """The fold that failed, in words; "" where none did, and in older ledgers."""

    @property
    def recorded(self) -> bool:
        """Return whether the ledger holds findings, which older ledgers lack."""
        return bool(self.printed or self.failed_fold) or any(fold.findings for fold in self.folds)


def settings_of_run(directory: Path) -> RunSettings:
    """Return the settings of a run, from its lock file.

    Raises:
        UserError: the lock file cannot be read.
    """
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
    experiment: Experiment, view: SearchView, store: Store, setting: RunSettings, *, bounded: bool
) -> ExperimentEvidence:
    """Collect the evidence on an experiment that has a result.

    Args:
        experiment, view: with the scores that are reported to the reader.
        store: artifacts of the run.
        setting: settings of the run.
        bounded: as in `findings_of`.
    """
    result, score = experiment.result, experiment.score
    assert result is not None
    findings = findings_of(store, experiment, bounded=bounded)
    known = findings if len(findings) == len(result.folds) else [None] * len(result.folds)
    names = view.started.folds or ("",) * len(result.folds)
    values = [f.value for f in score.folds] if score and score.folds else [None] * len(known)
    rows = zip(names, values, result.folds, known, strict=True) if result.folds else ()
    differences = _differences(experiment, view)
    compared = {experiment.number, *(one.experiment for one in differences)}
    failed = result.output is not None and not result.folds and not bounded
    return ExperimentEvidence(
        setting=setting,
        folds=tuple(
            FoldShown(name, value, kept.diagnostics, kept.fit_seconds, one)
            for name, value, kept, one in rows
        ),
        residuals=shared_residuals([one.residuals for one in findings]),
        held_out_residuals=shared_residuals([one.held_out_residuals for one in findings]),
        parameters=parameter_spreads(findings),
        differences=differences,
        noise=None if bounded else noise_of_repeats(view, compared),
        printed=store.text(result.output) if failed and result.output else "",
        failed_fold=_failed_fold(experiment, view),
    )


def _failed_fold(experiment: Experiment, view: SearchView) -> str:
    """ "" in older ledgers, which do not name their folds."""
    number, names = experiment.failure.fold if experiment.failure else None, view.started.folds
    return f"fold {number}, {names[number - 1]}" if number and number <= len(names) else ""


def _differences(experiment: Experiment, view: SearchView) -> tuple[ComparedScore, ...]:
    if experiment.score is None:
        return ()
    kept = [e for e in view.bests if e.number < experiment.number]
    others = [("best before", kept[-1])] if kept else []
    parent = experiment.proposed.parent
    if kept and parent == kept[-1].number:
        others = [("parent and best before", kept[-1])]
    elif parent is not None and parent != experiment.number:
        others.insert(0, ("parent", view.experiment(parent)))
    found: list[ComparedScore] = []
    for role, other in others:
        if other.score is not None and other.score.value > 0:
            apart = experiment.score.value - other.score.value
            found.append(ComparedScore(other.number, role, apart, apart / other.score.value))
    return tuple(found)
