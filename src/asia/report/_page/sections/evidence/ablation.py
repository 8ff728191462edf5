"""Section of the ablation: contributions of the changes to the gain of the winner."""

from __future__ import annotations

from asia.ledger import Ablated
from asia.report._page.html import Html, join, said, table, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject

_PARTS = (
    ("its model, with the training of the baseline", "crossing.model"),
    ("its training, with the model of the baseline", "crossing.training"),
    ("interaction of both", "crossing.interaction"),
    ("in all", "crossing.gain"),
)


def _write(subject: Subject) -> Html | None:
    found = subject.view.ablated
    if found is None:
        return None
    text = tag(
        "p",
        "The winner was refitted with parts of its changes reverted, each variant with up to ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator.",
    )
    return join((text, _crossing(subject, found), _left_out(subject, found)))


def _crossing(subject: Subject, found: Ablated) -> Html:
    if found.crossing is None:
        return tag("p", "Model and training cannot be crossed: ", said(found.detail), ".")
    rows: list[list[str | None]] = [[text, _interval(subject, found, at)] for text, at in _PARTS]
    head = ["part of the winner", f"{subject.view.v_name} is lower by"]
    return table(head, rows, "Contributions to the gain over the baseline")


def _left_out(subject: Subject, found: Ablated) -> Html | None:
    if not found.left_out:
        return None
    rows: list[list[str | None]] = []
    for k, one in enumerate(found.left_out):
        at = f"left_out.{k}"
        loss = said(one.detail) if one.loss is None else _interval(subject, found, f"{at}.loss")
        rows.append([subject.number(found, f"{at}.experiment", "number"), loss])
    head = ["without the change of", f"{subject.view.v_name} is higher by"]
    return table(head, rows, "Each change of the lineage left out")


def _interval(subject: Subject, found: Ablated, at: str) -> Html:
    value, low, high = (
        subject.number(found, f"{at}.{end}", "signed_error") for end in ("value", "low", "high")
    )
    return join((value, " (", low, " to ", high, ")"))


SECTION = Section("ablation", "Ablation", _write)
