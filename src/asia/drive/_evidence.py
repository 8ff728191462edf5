"""The evidence of an experiment as a desk gives it: in lines to read, and in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asia.data import Signal
from asia.errors import UserError
from asia.ledger import ComparedScore, FoldShown, Run, evidence_lines, evidence_of, settings_of_run
from asia.ledger.evidence.words import last_lines

_PRINTED_LINES = 40


@dataclass(frozen=True)
class FoldSummary:
    """One fold of an experiment."""

    held_out: str
    """Description of the held-out part."""
    V: float | None
    """V of the fold; None where it is not reported."""
    train_error: float
    """The metric on the training records, as it enters V."""
    errors: dict[str, float]
    """The metric of each output on the held-out part, as it enters V."""
    train_errors: dict[str, float]
    """The same on the training records."""
    steps: dict[str, dict[str, float]]
    """Step of a window -> output -> error on the held-out windows at that step."""
    fit_seconds: float
    """Duration of the fit."""
    compile_seconds: float | None
    """Compile time of JAX, s; None if not known."""
    memory_mb: float | None
    """The largest address space of the worker; None where it is not known."""
    parameters: dict[str, float]
    """Those that the model names."""
    printed: tuple[str, ...]
    """The last lines that the fit printed: the candidate's own words."""


@dataclass(frozen=True)
class EvidenceSummary:
    """Evidence on an experiment besides its score."""

    lines: tuple[str, ...]
    """Complete evidence as lines of text, most useful first."""
    folds: tuple[FoldSummary, ...]
    """Each fold in numbers; () for a failure."""
    residuals: tuple[str, ...]
    """Operating ranges in which the model is too high or too low on the training records."""
    held_out_residuals: tuple[str, ...]
    """The same on the held-out samples; () unless the problem shows these."""
    disagreeing: tuple[str, ...]
    """Parameters that the folds disagree on."""
    differences: tuple[ComparedScore, ...]
    """Differences of V to the parent and to the best before."""
    noise: float | None
    """The standard deviation of V over repeats; None where it was not measured."""
    fit_limit_seconds: float
    """Time limit of the fit of a fold, s."""
    memory_limit_mb: int
    """The largest address space of a worker."""


def evidence_summary(run: Run, number: int) -> EvidenceSummary:
    """Summarise the evidence on an experiment of a run whose view holds the reported scores.

    Raises:
        UserError: there is no such experiment, or it has no result.
    """
    experiment = run.view.experiment(number)
    if experiment.result is None:
        raise UserError(f"experiment {number} is being evaluated: it has no result yet")
    setting = settings_of_run(run.directory)
    bounded = run.view.started.ladder is not None
    found = evidence_of(experiment, run.view, run.store, setting, bounded=bounded)
    return EvidenceSummary(
        lines=tuple(evidence_lines(found)),
        folds=tuple(_fold(fold, setting.outputs) for fold in found.folds),
        residuals=tuple(
            one.residual.words(setting.inputs, setting.outputs) for one in found.residuals
        ),
        held_out_residuals=tuple(
            one.residual.words(setting.inputs, setting.outputs) for one in found.held_out_residuals
        ),
        disagreeing=tuple(one.name for one in found.parameters if one.disagrees),
        differences=found.differences,
        noise=found.noise,
        fit_limit_seconds=setting.fit_seconds,
        memory_limit_mb=setting.memory_mb,
    )


def _fold(fold: FoldShown, outputs: Sequence[Signal]) -> FoldSummary:
    known = fold.findings

    def by_output(values: Sequence[float]) -> dict[str, float]:
        return dict(zip((s.name for s in outputs), values, strict=False))

    return FoldSummary(
        held_out=fold.held_out,
        V=fold.value,
        train_error=fold.diagnostics.train_error,
        errors=by_output(known.errors if known else ()),
        train_errors=by_output(known.train_errors if known else ()),
        steps={str(s.step): by_output(s.errors) for s in (known.steps if known else ())},
        fit_seconds=round(fold.fit_seconds, 2),
        compile_seconds=round(known.compile_seconds, 2) if known else None,
        memory_mb=round(known.memory_mb) if known and known.memory_mb else None,
        parameters=dict(known.parameters) if known else {},
        printed=tuple(last_lines(known.printed, _PRINTED_LINES)) if known else (),
    )
