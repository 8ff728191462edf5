"""The sections of the page, from top to bottom.

A new one is a module with a `SECTION` and a line here.
"""

from __future__ import annotations

from typing import Final

from asia.report._page.section import Section
from asia.report._page.sections import (
    accuracy,
    experiments,
    handover,
    integrity,
    lineage,
    model,
    progress,
    reproduce,
    tested,
    validation,
    verdict,
)
from asia.report._page.sections.evidence import ablation, bands, confirmation, identified

SECTIONS: Final[tuple[Section, ...]] = (
    verdict.SECTION,
    model.SECTION,
    identified.SECTION,
    accuracy.SECTION,
    validation.SECTION,
    confirmation.SECTION,
    tested.SECTION,
    bands.SECTION,
    handover.SECTION,
    progress.SECTION,
    lineage.SECTION,
    ablation.SECTION,
    experiments.SECTION,
    integrity.SECTION,
    reproduce.SECTION,
)
