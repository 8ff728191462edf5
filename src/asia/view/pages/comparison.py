"""Two runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlencode

from asia.ledger import TestedModel, model_to_use, tested_model
from asia.report.pieces import (
    NARROW,
    WIDE,
    BestSoFar,
    Html,
    Subject,
    draw_best,
    held_out_overlays,
    join,
    overlay_legend,
    said,
    stamp,
    table,
    tag,
)
from asia.view._followed import Snapshot
from asia.view.pages.experiment import zoomable
from asia.view.pages.frame import run_address, section, whole_page
from asia.view.pages.runs import state_mark


def comparison_page(pair: Sequence[Snapshot], token: str) -> str:
    """The page of two runs."""
    names = [one.run.name for one in pair]
    query = urlencode([("run", name) for name in names])
    streams = [
        tag(
            "span",
            data_stream=f"{run_address(one.run.name)}/events",
            data_mark=one.mark,
            hidden=True,
        )
        for one in pair
    ]
    part = tag("div", comparison_part(pair), data_refresh=f"/compare/part?{query}")
    header = tag("header", tag("h1", "Comparison"))
    return whole_page(" and ".join(names), (("Searches", "/"),), (header, *streams, part), token)


def comparison_part(pair: Sequence[Snapshot]) -> Html:
    """Write the content of the page."""
    subjects = [one.subject for one in pair]
    columns = tag("div", *(_winner(one) for one in pair), class_="columns")
    parts = (
        section("figures", "Figures", _warning(subjects), _figures(subjects)),
        section("curves", "Best so far", _curves(subjects)),
        section("winners", "The best candidates", overlay_legend(), columns),
    )
    return join(parts)


def _warning(subjects: Sequence[Subject]) -> Html | None:
    starts = [one.view.started for one in subjects]
    if len({(s.problem, s.protocol_digest) for s in starts}) == 1:
        if len({one.view.v_name for one in subjects}) == 1:
            return None
        return tag(
            "p",
            "V was computed under different rules in the two runs: do not compare it.",
            class_="trouble",
        )
    return tag(
        "p",
        "The runs have different problems or protocols: do not compare their V.",
        class_="trouble",
    )


def _figures(subjects: Sequence[Subject]) -> Html:
    rows = [
        ("state", [state_mark(s.run.state) for s in subjects]),
        ("verdict", [_stamp(s) for s in subjects]),
        ("problem", [said(s.view.started.problem) for s in subjects]),
        ("agent", [said(s.view.started.agent) for s in subjects]),
        ("seed", [s.number(s.view.started, "seed", "text") for s in subjects]),
        ("isolation", [said(s.view.started.isolation_words) for s in subjects]),
        ("experiments", [s.over("evaluated", "experiment", "count", "count") for s in subjects]),
        ("spent on them", [s.over("evaluated", "seconds", "sum", "duration") for s in subjects]),
        ("V, the best", [_best(s) for s in subjects]),
        *(
            (f"V, {name}", [_reference(s, name) for s in subjects])
            for name in _references(subjects)
        ),
        ("error on the sealed test", [_tested(s) for s in subjects]),
    ]
    head = ["", *(tag("a", said(s.run.name), href=run_address(s.run.name)) for s in subjects)]
    return tag(
        "div", table(head, [(text, *cells) for text, cells in rows], "Both runs"), class_="both"
    )


def _stamp(subject: Subject) -> Html:
    text, kind = stamp(subject)
    return tag("span", text, class_=f"stamp small {kind}")


def _best(subject: Subject) -> Html:
    best = subject.view.best
    return subject.v(best) if best is not None else tag("span", "no score")


def _references(subjects: Sequence[Subject]) -> list[str]:
    names = {reference.name: None for subject in subjects for reference in subject.view.rungs}
    return list(names)


def _reference(subject: Subject, name: str) -> Html:
    reference = subject.rung(name)
    if reference is None:
        return tag("span", "none")
    return subject.number(reference[0], "outcome.value", "error")


def _tested(subject: Subject) -> Html:
    """Write the test scores of the models to use, once the test was opened."""
    opened, named = subject.view.unsealed, model_to_use(subject.view)
    if opened is None or named is None:
        return tag("span", "not opened")
    place = named.model if getattr(opened, named.model) is not None else "ensemble"
    if not isinstance(tested_model(opened, named.model), TestedModel):
        return tag("span", "no answer")
    return subject.number(opened, f"{place}.scores.0.value", "sig4")


def _curves(subjects: Sequence[Subject]) -> Html:
    searches = [_best_so_far(one) for one in subjects]
    alt = "Best V so far of both runs over the experiments."
    names = {one.view.v_name for one in subjects}
    axis = names.pop() if len(names) == 1 else "V"
    drawings = [
        tag("div", draw_best(searches, axis, alt, size), class_=name)
        for size, name in ((WIDE, "wide"), (NARROW, "narrow"))
    ]
    return tag("figure", *drawings)


def _best_so_far(subject: Subject) -> BestSoFar:
    finished = subject.view.finished
    kept = tuple((e.number, e.score.value) for e in subject.view.bests if e.score is not None)
    return BestSoFar(subject.run.name, kept, max((e.number for e in finished), default=0))


def _winner(snapshot: Snapshot) -> Html:
    subject, name = snapshot.subject, snapshot.run.name
    best = subject.view.best
    title = tag("h3", said(name))
    if best is None:
        return tag("div", title, tag("p", "There is no score yet."))
    link = tag(
        "a",
        subject.name(best),
        " ",
        said(best.proposed.title),
        href=f"{run_address(name)}/experiments/{best.number}",
    )
    overlays = held_out_overlays(subject, best)
    boxes = [zoomable(snapshot, best.number, k, len(o.measured)) for k, o in enumerate(overlays)]
    return tag("div", title, tag("p", link, ", V ", subject.v(best)), *boxes)
