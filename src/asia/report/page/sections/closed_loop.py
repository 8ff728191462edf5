"""Closed loop of the best candidate of a control problem: costs, and responses in held-out
scenarios."""

from __future__ import annotations

import numpy as np

from asia.judge.evaluation.references import CONTROLLERS
from asia.ledger.simulated import fold_outputs
from asia.problem.metrics import find_metric
from asia.report.page.html import Html, join, said, table, tag
from asia.report.page.subject import Section, Subject, result_of
from asia.report.page.svg import Overlay, draw_overlay, legend

_MOST_PANELS = 8


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
    costs = table(
        ["controller", "V", "in V of the best candidate"], rows, "Costs in held-out scenarios"
    )
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
    shown = [draw_overlay(problem, one) for one in _overlays(subject)[:_MOST_PANELS]]
    entries = [("measured", "set point"), ("model", "response"), ("error", "input")]
    text = (
        "The controller of each fold ran in scenarios that it was not designed for: set points, "
        "disturbances, noise and plant parameters. V is the error of each signal in units of its "
        "tolerance, mean over the controlled outputs and the changes of the inputs."
    )
    return join(
        (
            tag("p", text),
            costs,
            table(head, each, "The best candidate on each fold"),
            legend(entries),
            tag("div", *shown, class_="grid"),
        )
    )


def _overlays(subject: Subject) -> list[Overlay]:
    """Responses in the held-out scenarios, each output with the input that moves most."""
    problem, best = subject.problem, subject.view.best
    assert problem is not None
    assert problem.control is not None
    assert best is not None
    control, found = problem.control, list[Overlay]()
    outputs = fold_outputs(subject.run.store, best.folds, subject.folds)
    start = np.array([a.start for a in control.actuators])
    ranges = np.array([a.max - a.min for a in control.actuators])
    for fold, y_hat in zip(subject.folds, outputs, strict=True):
        for block, response in zip(fold.held_out, y_hat, strict=True):
            inputs = start + np.cumsum(response[:, len(control.controlled) :], axis=0)
            shown = int(np.argmax(np.ptp(inputs, axis=0) / ranges))
            for channel in range(len(control.controlled)):
                found.append(
                    Overlay(
                        title=join((said(f"fold {fold.index + 1}, {block.name}"),)),
                        alt=f"scenario {block.name}",
                        channel=channel,
                        first=0,
                        measured=block.y,
                        simulated=response,
                        below=(control.base.inputs[shown].label, inputs[:, shown]),
                    )
                )
    return found


SECTION = Section("loop", "Closed loop", _write)
