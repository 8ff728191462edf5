"""The sections of the page, from top to bottom.

A new section is a `Section` in one of these modules and a line here.
"""

from __future__ import annotations

from typing import Final

from asia.report.page.sections import closed_loop, evidence, experiments, integrity, verdict
from asia.report.page.subject import Section

SECTIONS: Final[tuple[Section, ...]] = (
    verdict.SECTION,
    experiments.PROBLEM,
    experiments.MODEL,
    evidence.IDENTIFIED,
    evidence.LINEAR,
    evidence.CONTROL,
    evidence.CERTIFICATE,
    verdict.ACCURACY,
    closed_loop.SECTION,
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
