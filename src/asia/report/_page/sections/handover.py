"""The model to use, why this one, and how."""

from __future__ import annotations

from collections.abc import Iterator

from asia._text import one_line
from asia.ledger import Refitted, model_to_use
from asia.report._page.code import python
from asia.report._page.html import Html, facts, join, said, table, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject


def _write(subject: Subject) -> Html | None:
    view = subject.view
    named, refitted = model_to_use(view), view.refitted
    if named is None:
        return None
    parts: list[Html | None] = [
        facts((("use", tag("b", named.model)), ("because", said(named.reason, 600))))
    ]
    if refitted is not None:
        rows = list(_rows(subject, refitted))
        if rows:
            head = ["model", "error on the training records", "difference from the ensemble"]
            parts.append(table(head, rows, "Final models"))
        parts += [_stack(subject, refitted), _again(subject, refitted)]
    name = one_line(view.started.run, 120).replace('"', "'")
    source = (
        f'import asia\n\nfound = asia.simulate("runs/{name}", past_u, past_y, u, bands=0.9)\n'
        "found.y_hat, found.lower, found.upper, found.outside\n"
    )
    parts += [tag("h3", "In a program"), python(source, "how to simulate with the model")]
    return join(parts)


def _rows(subject: Subject, refitted: Refitted) -> Iterator[list[str | None]]:
    check = refitted.check
    if check is None:
        return
    for k, error in enumerate(check.fold_errors):
        name = join(("model of fold ", tag("span", f"{k + 1}", class_="fixed")))
        shown = (
            None if error is None else subject.number(refitted, f"check.fold_errors.{k}", "error")
        )
        yield [name, shown or "no answer", None]
    if check.ensemble_error is not None:
        yield ["ensemble", subject.number(refitted, "check.ensemble_error", "error"), None]
    for k, start in enumerate(check.starts):
        at = f"check.starts.{k}"
        kept = check.kept == k + 1
        error, apart = (
            None if value is None else subject.number(refitted, f"{at}.{name}", "error")
            for name, value in (("error", start.error), ("disagreement", start.disagreement))
        )
        objection = join((" ", said(f"({start.objection})"))) if start.objection else None
        yield [
            join(("refit" if kept else "refit, not used", objection)),
            error or "no answer",
            apart,
        ]


def _stack(subject: Subject, refitted: Refitted) -> Html | None:
    if refitted.stack is None:
        return None
    members = [
        join(
            (
                subject.number(refitted, f"stack.members.{k}.experiment", "number"),
                " with weight ",
                subject.number(refitted, f"stack.members.{k}.weight", "fixed2"),
            )
        )
        for k in range(len(refitted.stack.members))
    ]
    value = subject.number(refitted, "stack.value", "error")
    return tag("p", "Stack: ", join(members, ", "), "; nested V ", value, ".")


def _again(subject: Subject, refitted: Refitted) -> Html | None:
    again = refitted.again
    if again is None:
        return None
    fold = subject.number(refitted, "again.fold", "count")
    if again.ratio is None:
        return tag("p", "Fold ", fold, ", refitted, fails: ", said(again.failed), ".")
    if again.ratio == 1.0:
        return tag("p", "Fold ", fold, ", refitted, gave the same result.")
    ratio = subject.number(refitted, "again.ratio", "sig4")
    return tag("p", "Fold ", fold, ", refitted, has ", ratio, " times its error.")


SECTION = Section("use", "The model to use", _write)
