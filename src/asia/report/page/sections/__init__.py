"""The sections of the page, from top to bottom.

A new section is a `Section` in one of these modules and a line here.
"""

from __future__ import annotations

from functools import cache

from asia._plugins import ordered
from asia.report.page.sections import evidence, experiments, integrity, verdict
from asia.report.page.subject import Section, plugged_sections

_OWN = (
    verdict.SECTION,
    experiments.PROBLEM,
    experiments.MODEL,
    evidence.IDENTIFIED,
    evidence.LINEAR,
    verdict.ACCURACY,
    evidence.VALIDATION,
    evidence.CONFIRMATION,
    verdict.TESTED,
    verdict.HANDOVER,
    experiments.PROGRESS,
    experiments.TRADEOFF,
    experiments.LINEAGE,
    evidence.SECTION,
    experiments.SECTION,
    experiments.NOTES,
    integrity.SECTION,
    integrity.REPRODUCE,
)


@cache
def page_sections() -> tuple[Section, ...]:
    """Return the sections of this package and of plug-ins, in their order."""
    others = {one.key: one.after for one in plugged_sections()}
    by_key = {one.key: one for one in (*plugged_sections(), *_OWN)}
    return tuple(by_key[key] for key in ordered([one.key for one in _OWN], others))
