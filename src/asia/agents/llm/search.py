"""Summary of the search for a language model, and the request to it.

A pure function of the view: no measured time, no paths, nothing that would differ in a second run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from typing import Literal

import numpy as np

from asia._text import one_line
from asia.agents._view import AgentView, Trial
from asia.agents.llm.text import bounded, fenced, quoted
from asia.ledger import Diagnostics, error_line

NO_CANDIDATE = "none"
ERROR = 300

_SOURCE = 16_000
_SAID = 300
_TITLE = 80
_NOTE = 1000
_NOTES = 10
_TOLD = 5
_BEST = 10
_RECENT = 40
_EVIDENCE = 60

_MEANING = """\
train_error: the metric on the training folds (far below V: overfitted; about V: too simple);
bias, whiteness (autocorrelation), input_correlation, curvature of the training residuals: 0 is
best, below 0.1 is little; top, bottom, start_error: error at high outputs, at low outputs, at the
beginning, over the mean error: 1 is even."""


@dataclass(frozen=True)
class Task:
    """Task of the next candidate. `repair` corrects trial `parent`, which failed."""

    kind: Literal["explore", "refine", "repair"]
    parent: int | None = None


def task_of(view: AgentView, repairs: int) -> Task:
    """Choose the task: repair the last failure, at most `repairs` times in a row, unless a repair
    is running; else the task of the present phase."""
    failed: list[Trial] = []
    for trial in reversed(view.trials):
        sound = trial.value is not None or trial.status == "discard"
        if sound or (failed and failed[-1].parent != trial.number):
            break
        failed.append(trial)
    last = failed[0] if failed else None
    mended = last is not None and any(known.parent == last.number for known in view.running)
    if last is not None and last.family != NO_CANDIDATE and len(failed) <= repairs and not mended:
        return Task("repair", last.number)
    if view.phase == "explore":
        return Task("explore")
    return Task("refine", view.best.number if view.best else None)


def search_text(view: AgentView, task: Task, hide_baseline: bool = False) -> str:
    """The user message.

    Args:
        hide_baseline: leave out the source of experiment 1
    """
    shown = _Shown(view, hide_baseline)
    parts = [
        f"{len(view.trials)} experiments done, {view.remaining} left. Phase: {view.phase}.",
        "# Experiments\n" + "\n".join(_lines(view)),
        "# Families tried\n" + "\n".join(_families(view)),
    ]
    if view.running:
        parts.insert(2, "# Running now, without a result yet\n" + "\n".join(_running(view)))
    if view.best is not None:
        parts.append("# Best so far\n" + "\n".join(shown.best(view.best)))
    last = view.trials[-1] if view.trials else None
    if last is not None and last is not view.best and last.evidence:
        parts.append("# The last experiment\n" + "\n".join((_line(last), *_evidence(last))))
    if task.kind == "repair" and task.parent is not None:
        parts.append("# To mend\n" + "\n".join(shown.failed(task.parent)))
    if view.notes:
        said = "\n".join(f"- {bounded(note, _NOTE)}" for note in view.notes[-_NOTES:])
        parts.append(f"# Notes of the person who runs this search\n{said}")
    parts.append(f"# Task\n{_ask(view, task)}{_apart(view)}")
    return "\n\n".join(parts)


def _lines(view: AgentView) -> Iterator[str]:
    """One line each: the best, the most recent, and how many are left out."""
    best = {trial.number for trial in view.ranked[:_BEST]}
    recent = {trial.number for trial in view.trials[-_RECENT:]}
    kept = [trial for trial in view.trials if trial.number in best | recent]
    if len(kept) < len(view.trials):
        yield f"({len(view.trials) - len(kept)} older ones are left out)"
    shown = {trial.number for trial in view.trials[-_TOLD:]}
    for trial in kept:
        yield _line(trial)
        if trial.number in shown:
            yield (
                f"    hypothesis {quoted(trial.hypothesis, _SAID)}, expected "
                f"{quoted(trial.expected, _SAID)}"
            )


def _running(view: AgentView) -> Iterator[str]:
    for known in view.running:
        origin = f" from #{known.parent}" if known.parent is not None else ""
        yield (
            f"#{known.number}{origin} {quoted(known.family, 40)} {quoted(known.title, _TITLE)}: "
            f"hypothesis {quoted(known.hypothesis, _SAID)}"
        )


def _line(trial: Trial) -> str:
    origin = f" from #{trial.parent}" if trial.parent is not None else ""
    head = (
        f"#{trial.number} {trial.status}{origin} {quoted(trial.family, 40)} "
        f"{quoted(trial.title, _TITLE)}"
    )
    if trial.value is not None:
        folds = ", ".join(f"{v:.5g}" for v in trial.folds)
        train = trial.train_error
        tail = "" if train is None else f", train_error {train:.4g}"
        parts = f" (folds {folds})" if folds else ""
        return f"{head}: V {trial.value:.5g}{parts}{tail}"
    return f"{head}: {one_line(trial.failure or 'failed', 200)}{_words(trial)}"


def _words(trial: Trial) -> str:
    line = error_line(trial.error, ERROR)
    return f"; it said {quoted(line, ERROR)}" if line else ""


def _families(view: AgentView) -> Iterator[str]:
    """Yield the kinds of models tried and their best V; a kind whose trials all failed, or that
    stays far behind, is a dead end."""
    best = view.best
    for name in dict.fromkeys(trial.family for trial in view.trials):
        trials = [trial for trial in view.trials if trial.family == name]
        values = [trial.value for trial in trials if trial.value is not None]
        failures = len(trials) - len(values)
        found = f"best V {min(values):.5g}" if values else "no score: a dead end so far"
        if values and best is not None and best.value is not None and min(values) > 2 * best.value:
            found += ", far behind"
        yield f"- {quoted(name, 40)}: {len(trials)} tried, {failures} failed, {found}"


@dataclass(frozen=True)
class _Shown:
    view: AgentView
    hide_baseline: bool

    def best(self, trial: Trial) -> Iterator[str]:
        """The incumbent with its evidence."""
        yield _line(trial)
        for fold, diagnostics in enumerate(trial.diagnostics, 1):
            yield f"fold {fold}, training side: {_numbers(diagnostics)}"
        for fold, curve in enumerate(trial.curves, 1):
            if curve:
                losses = np.array([loss for _, loss in curve])
                yield (
                    f"fold {fold}, logged loss: {losses[0]:.4g} at step {curve[0][0]:g}, least "
                    f"{losses.min():.4g}, {losses[-1]:.4g} at step {curve[-1][0]:g}"
                )
        yield _MEANING
        yield from _evidence(trial)
        yield self._source(trial)

    def failed(self, number: int) -> Iterator[str]:
        """Describe the trial to correct."""
        for trial in self.view.trials:
            if trial.number == number:
                yield _line(trial)
                yield self._source(trial)

    def _source(self, trial: Trial) -> str:
        if self.hide_baseline and trial.number == 1:
            return "(its source is not shown)"
        return f"source of #{trial.number}:\n{fenced(trial.source, _SOURCE)}"


def _evidence(trial: Trial) -> Iterator[str]:
    """Bounded already; each line is one line whatever a candidate printed."""
    yield from trial.evidence[:_EVIDENCE]


def _numbers(diagnostics: Diagnostics) -> str:
    values = zip(fields(diagnostics), astuple(diagnostics), strict=True)
    return ", ".join(f"{field.name} {value:.4g}" for field, value in values)


def _apart(view: AgentView) -> str:
    if not view.running:
        return ""
    return (
        " Do not wait for what is running, and do not repeat it: take another direction, so that "
        "the results say different things."
    )


def _ask(view: AgentView, task: Task) -> str:
    if task.kind == "repair":
        return (
            f"Experiment #{task.parent} failed. Find the cause, and answer with the mended, "
            "complete candidate.py; keep its idea."
        )
    if task.kind == "explore":
        return (
            "Explore: propose a candidate of a family that is not among those tried, as different "
            "from them as the physics allows, in a simple first version."
        )
    leader = f"#{task.parent}" if task.parent is not None else "what there is"
    return (
        f"Refine: propose a candidate that beats {leader}. Say what its evidence tells you, and "
        "change one thing for a reason; or combine what worked."
    )
