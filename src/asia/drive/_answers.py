"""Answers of the submission server: state of a submission, of an experiment and of the search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Literal

from asia._text import one_line
from asia.drive._queue import TITLE
from asia.evaluation import DryRun
from asia.ledger import Diagnostics, Experiment, Run, error_line

_PRINTED_LINES = 10
# Message of XLA's locks if a system-call filter refuses one.
_NOT_ITS_OWN = "[mutex.cc :"

SubmissionState = Literal["queued", "running", "done", "withdrawn", "unknown"]


@dataclass(frozen=True)
class Submission:
    """State of a submitted candidate."""

    ticket: str
    """Identifier of the submission, before and after it becomes an experiment."""
    state: SubmissionState
    """`withdrawn` only in the answer to taking it back; afterwards, as for a ticket never given,
    it is `unknown`."""
    ahead: int = 0
    """Number of submissions before it in the queue."""
    experiment: int | None = None
    """Its number, once it is an experiment."""
    repeated: bool = False
    """True if the same source was submitted before, so that this answer costs no experiment."""


@dataclass(frozen=True)
class ExperimentSummary:
    """An experiment in few words, safe to show to anyone: no output of the candidate but one
    bounded line of its own error."""

    experiment: int
    """Its number, from 1."""
    status: str
    """Keep, discard, or how it failed."""
    value: float | None
    """V; None without a score."""
    folds: tuple[float, ...]
    """V of each fold."""
    reason: str | None
    """Why there is no score, one word."""
    advice: str | None
    """Recommended action."""
    detail: str | None
    """The last line of the candidate's own error."""
    title: str
    """The candidate's title, one line."""
    parent: int | None
    """The experiment it was made from."""
    seconds: float
    """Duration of the evaluation, s."""
    duplicate_of: int | None
    """Experiment with the same source, whose outcome applies."""
    training: Diagnostics | None
    """Residual analysis of the training side, in each figure the worst of the folds."""


@dataclass(frozen=True)
class SearchProgress:
    """State of the search."""

    run: str
    """Name of the run."""
    problem: str
    """Name of the problem."""
    state: str
    """State as in `asia status`: running, interrupted, finished or unsealed."""
    experiments: int
    """Experiments finished."""
    budget: int
    """Experiments in all."""
    v_name: str
    """Label of V in this search."""
    best: int | None
    """Number of the incumbent."""
    best_value: float | None
    """V of the incumbent."""
    rungs: dict[str, float | None]
    """V of each trivial reference; None where it has none."""
    notes: tuple[str, ...]
    """Notes of the user to the agent."""
    running: int | None = None
    """Number of the experiment that is being evaluated."""

    @property
    def remaining(self) -> int:
        """Experiments left."""
        return max(0, self.budget - self.experiments)


@dataclass(frozen=True)
class DryRunSummary:
    """Summary of a dry run."""

    reason: str | None
    """Why the candidate would have no score, one word; None where nothing was found."""
    advice: str | None
    """Recommended action."""
    detail: str | None
    """The last line of the candidate's own error."""
    printed: tuple[str, ...]
    """The last lines that the candidate printed, bounded; its own words."""
    samples: int
    """Samples that it was fitted to."""
    of_samples: int
    """Samples that the whole first fold trains on."""
    fit_seconds: float | None
    """Duration of the fit, s; None if it failed."""
    compile_seconds: float
    """Part of the total time that JAX spent on tracing and compiling, s."""
    simulate_seconds: float
    """Duration of the simulations without compilation, s."""
    whole_fit_seconds: float | None
    """The fit of the whole fold, if its time but for compilation grows as the samples do."""
    limit_seconds: float
    """The limit of a fit in a try."""
    allowed_seconds: float
    """The limit of the fit in this dry run."""


def printed_lines(output: str) -> tuple[str, ...]:
    """The last lines that a candidate printed, without those that libraries write in a sandbox."""
    lines = [one for one in output.splitlines() if not one.startswith(_NOT_ITS_OWN)]
    return tuple(one_line(line) for line in lines[-_PRINTED_LINES:])


def dry_run_summary(found: DryRun) -> DryRunSummary:
    """A dry run in few words."""
    failure, whole = found.failure, found.whole_fit_seconds()
    fit = found.fit_seconds
    return DryRunSummary(
        reason=failure.reason.value if failure else None,
        advice=failure.advice if failure else None,
        detail=(error_line(failure.detail) or None) if failure else None,
        printed=printed_lines(found.output),
        samples=found.samples,
        of_samples=found.of_samples,
        fit_seconds=None if fit is None else round(fit, 2),
        compile_seconds=round(found.compile_seconds, 2),
        simulate_seconds=round(found.simulate_seconds, 2),
        whole_fit_seconds=None if whole is None else round(whole, 1),
        limit_seconds=found.limit_seconds,
        allowed_seconds=found.allowed_seconds,
    )


def summary_of(experiment: Experiment) -> ExperimentSummary:
    """An evaluated experiment in few words."""
    p, r, score, failure = (
        experiment.proposed, experiment.result, experiment.score, experiment.failure,
    )  # fmt: skip
    assert r is not None
    return ExperimentSummary(
        experiment=experiment.number,
        status=r.status,
        value=score.value if score else None,
        folds=tuple(f.value for f in score.folds) if score else (),
        reason=failure.reason.value if failure else None,
        advice=failure.advice if failure else None,
        detail=(error_line(failure.detail) or None) if failure else None,
        title=one_line(p.title, TITLE),
        parent=p.parent,
        seconds=round(r.seconds, 1),
        duplicate_of=r.duplicate_of,
        training=_worst([f.diagnostics for f in r.folds]),
    )


def _worst(folds: Sequence[Diagnostics]) -> Diagnostics | None:
    if not folds:
        return None
    return Diagnostics(*(max(values) for values in zip(*map(astuple, folds), strict=True)))


def progress_of(run: Run) -> SearchProgress:
    """Return the state of a run."""
    view = run.view
    best = view.best
    return SearchProgress(
        run=view.started.run,
        problem=view.started.problem,
        state=run.state,
        experiments=len(view.finished),
        budget=view.leg_end,
        v_name=view.v_name,
        best=best.number if best else None,
        best_value=best.score.value if best and best.score else None,
        rungs={r.name: getattr(r.outcome, "value", None) for r in view.rungs},
        notes=tuple(note.text for note in view.notes),
        running=view.pending.number if view.pending is not None else None,
    )
