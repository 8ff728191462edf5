"""Closed loop of the winner of a control problem: costs, and responses in held-out scenarios."""

from __future__ import annotations

from asia.judge.evaluation.references import CONTROLLERS
from asia.problem.metrics import find_metric
from asia.report.page.html import Html, join, said, table, tag
from asia.report.page.sections.verdict import draw_held_out
from asia.report.page.subject import Section, Subject, result_of


def _write(subject: Subject) -> Html | None:
    best, problem = subject.view.best, subject.problem
    if best is None or best.score is None or problem is None or problem.control is None:
        return None
    result = result_of(best)
    rows = [[said(best.proposed.title), subject.v(best), None]]
    for name in CONTROLLERS:
        found = subject.reference(name)
        if found is not None:
            pair = (found[0], "outcome.value"), (result, "outcome.value")
            ratio = subject.made("ratio", "times", *pair)
            rows.append([said(name), subject.number(found[0], "outcome.value", "error"), ratio])
    costs = table(["controller", "V", "in V of the winner"], rows, "Costs in held-out scenarios")
    metric = find_metric(problem.protocol.metric)
    field = metric.name if metric.name in ("rmse", "mae") else "other"
    head = ["fold", "V", *(said(f"{metric.label} {s.label}") for s in problem.outputs)]
    each = [
        [
            said(f"{k + 1}: {subject.view.started.folds[k]}"),
            subject.number(result, f"outcome.folds.{k}.value", "error"),
            *(
                subject.number(result, f"outcome.folds.{k}.{field}.{c}", "sig4")
                for c in range(len(problem.outputs))
            ),
        ]
        for k in range(len(best.score.folds))
    ]
    text = (
        "The controller of each fold ran in scenarios that it was not designed for: set points, "
        "disturbances, noise and plant parameters. V is the error of each signal in units of its "
        "tolerance, mean over the controlled outputs and the changes of the inputs."
    )
    return join(
        (
            tag("p", text),
            costs,
            table(head, each, "The winner on each fold"),
            draw_held_out(subject, best),
        )
    )


SECTION = Section("loop", "Closed loop", _write)
