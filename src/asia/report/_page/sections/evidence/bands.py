"""Section of the output bands: their coverage on the sealed test."""

from __future__ import annotations

from asia.report._page.html import Html, facts, join, said, table
from asia.report._page.section import Section
from asia.report._page.subject import Subject


def _write(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None or opened.bands is None:
        return None
    bands = opened.bands
    pairs = (
        ("model", bands.model),
        ("nominal coverage", subject.number(opened, "bands.level", "share")),
        ("outside the region of validity", subject.number(opened, "bands.outside", "share")),
    )
    rows = [
        [said(name), subject.number(opened, f"bands.covered.{c}", "share")]
        for c, name in enumerate(opened.channels[: len(bands.covered)])
    ]
    head = ["output", "coverage of the test samples"]
    return join((facts(pairs), table(head, rows, "The bands on the sealed test")))


SECTION = Section("bands", "Output bands", _write)
