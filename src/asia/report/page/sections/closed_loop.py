"""Closed loop of the best candidate of a control problem: costs, and responses in held-out
scenarios."""

from __future__ import annotations

from typing import Any

from asia.judge.evaluation.references import CONTROLLERS
from asia.presentation.table import FORMATS
from asia.problem.metrics import find_metric
from asia.report.page.sections.verdict import draw_held_out
from asia.report.page.subject import Section, Subject


def _content(subject: Subject) -> dict[str, Any] | None:
    best, problem = subject.view.best, subject.problem
    if best is None or best.score is None or problem is None or problem.control is None:
        return None
    score, error, sig = best.score, FORMATS["error"], FORMATS["sig"]
    rows = [[best.proposed.title, subject.v(best), ""]]
    for name in CONTROLLERS:
        value = subject.reference(name)
        if value is not None:
            rows.append([name, error(value), FORMATS["times"](value / score.value)])
    metric = find_metric(problem.protocol.metric)
    head = ["fold", "V", *(f"{metric.label} {s.label}" for s in problem.outputs)]
    each = [
        [
            f"{k + 1}: {subject.view.started.folds[k]}",
            error(fold.value),
            *(sig(fold.per_channel(metric.name)[c]) for c in range(len(problem.outputs))),
        ]
        for k, fold in enumerate(score.folds)
    ]
    return {"costs": rows, "head": head, "folds": each, "drawn": draw_held_out(subject, best)}


SECTION = Section("loop", "Closed loop", _content)
