"""The sections of the page, from top to bottom.

A new one is a module with a `SECTION` and a line here.
"""

from __future__ import annotations

from typing import Final

from asia.report.page.sections import evidence as ablation
from asia.report.page.sections import evidence as bands
from asia.report.page.sections import evidence as confirmation
from asia.report.page.sections import evidence as identified
from asia.report.page.sections import evidence as validation
from asia.report.page.sections import experiments, integrity, verdict
from asia.report.page.sections import experiments as lineage
from asia.report.page.sections import experiments as model
from asia.report.page.sections import experiments as progress
from asia.report.page.sections import integrity as reproduce
from asia.report.page.sections import verdict as accuracy
from asia.report.page.sections import verdict as handover
from asia.report.page.sections import verdict as tested
from asia.report.page.subject import Section

SECTIONS: Final[tuple[Section, ...]] = (
    verdict.SECTION,
    model.MODEL,
    identified.IDENTIFIED,
    accuracy.ACCURACY,
    validation.VALIDATION,
    confirmation.CONFIRMATION,
    tested.TESTED,
    bands.BANDS,
    handover.HANDOVER,
    progress.PROGRESS,
    lineage.LINEAGE,
    ablation.SECTION,
    experiments.SECTION,
    integrity.SECTION,
    reproduce.REPRODUCE,
)
