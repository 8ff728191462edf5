"""Pictures of a run and of a problem. Reads ledger views and artifacts; scores nothing.

Importing this package is cheap: matplotlib is loaded when the first picture is drawn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from asia.report.comparison import (
    ArmCurves,
    ArmsPicture,
    BenchPictures,
    ComparedValue,
    Curve,
    PublishedMee,
)
from asia.report.published import (
    Board,
    Entry,
    OfficialFigure,
    Standing,
    leaderboard,
    official_figures,
    read_board,
)
from asia.report.simulated import SimulatedCase, SimulatedCases, simulated_cases

if TYPE_CHECKING:
    from asia.report.brief import brief_html
    from asia.report.files import (
        draw_all_boards,
        draw_bench,
        draw_cases,
        draw_problem,
        write_figures,
        write_report,
        write_validation,
    )
    from asia.report.page.page import write_bundle, write_page
    from asia.report.paper import methods_paragraph, write_tables

__all__ = [
    "ArmCurves",
    "ArmsPicture",
    "BenchPictures",
    "Board",
    "ComparedValue",
    "Curve",
    "Entry",
    "OfficialFigure",
    "PublishedMee",
    "SimulatedCase",
    "SimulatedCases",
    "Standing",
    "brief_html",
    "draw_all_boards",
    "draw_bench",
    "draw_cases",
    "draw_problem",
    "leaderboard",
    "methods_paragraph",
    "official_figures",
    "read_board",
    "simulated_cases",
    "write_bundle",
    "write_figures",
    "write_page",
    "write_report",
    "write_tables",
    "write_validation",
]

_HOMES = {
    "brief_html": "brief",
    "draw_all_boards": "files",
    "draw_bench": "files",
    "draw_cases": "files",
    "draw_problem": "files",
    "methods_paragraph": "paper",
    "write_bundle": "page.page",
    "write_figures": "files",
    "write_page": "page.page",
    "write_report": "files",
    "write_tables": "paper",
    "write_validation": "files",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'asia.report' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"asia.report.{_HOMES[name]}"), name)
