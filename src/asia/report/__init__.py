"""Pictures of a run and of a problem. Reads ledger views and artifacts; scores nothing.

Importing this package is cheap: matplotlib is loaded when the first picture is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
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
    from asia.judge.scoring.checks.check import Check
    from asia.problem.problem import Problem
    from asia.report.page.page import PublishedRuns

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


def write_report(
    directory: Path, *, missing_only: bool = False, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Draw the run in `directory` into `<directory>/report`, each picture as PNG and PDF;
    missing_only: only those that are not there; failed: receives a line for each picture that
    cannot be drawn, whose file shows that line.

    progress: V against experiments. simulation and residuals: the best experiment on its held-out
    folds, once there is one. test and, for a benchmark with published results, leaderboard: once
    the test was opened. Returns the paths written. Raises UserError when `directory` is not a run,
    or its records, artifacts or training data are not what they were.
    """
    from asia.report.files import write

    return write(directory, missing_only=missing_only, failed=failed)


def write_validation(
    directory: Path, checks: Sequence[Check], title: str, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Draw the checks of a dossier into `<directory>/report` as validation.png and validation.pdf.
    failed: as in `write_report`. Returns the paths written."""
    from asia.report.files import write_validation

    return write_validation(directory, checks, title, failed)


def brief_html(directory: Path) -> str:
    """The run in `directory` for a notebook: V, the model to use, the problem's equations and the
    simulation of held-out parts as a picture. Raises UserError when `directory` is not a run."""
    from asia.report.brief import brief_html

    return brief_html(directory)


def write_page(directory: Path) -> Path:
    """Write all about the run in `directory` on one page, `<directory>/report/report.html`, which
    opens offline; the same ledger gives the same bytes.

    Raises UserError when `directory` is not a run, or its records, artifacts or training data are
    not what they were, and InternalError, before anything is written, where a number of the page is
    not what the ledger says.
    """
    from asia.report.page.page import write_page

    return write_page(directory)


def write_bundle(runs: Path, directory: Path) -> PublishedRuns:
    """A static site of the runs below `runs` into `directory`, to publish: `index.html` and a page
    for each run. Runs whose data or artifacts are not what they were are left out, and named.
    Raises UserError where there is no run."""
    from asia.report.page.page import write_bundle

    return write_bundle(runs, directory)


def write_figures(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """The pictures of a run for a paper, into `directory`, each as PDF, SVG and PNG: as wide as a
    column (3.5 inches) where the picture has one column of panels, else as a page with two columns
    (7.16 inches). Returns the paths written. Raises UserError as `write_report`."""
    from asia.report.paper.figures import write_figures

    return write_figures(run_directory, directory)


def write_tables(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """LaTeX tables of a run into `directory`: `experiments.tex`, `winner.tex`, and `test.tex` once
    the test was opened. Returns the paths written. Raises UserError when `run_directory` is not a
    run."""
    from asia.report.paper.text import write_tables

    return write_tables(run_directory, directory)


def methods_paragraph(directory: Path) -> str:
    """Write the methods paragraph of a paper from the ledger of a run.

    Args:
        directory: run directory.

    Raises:
        UserError: the directory is not a run.
    """
    from asia.report.paper.text import methods_paragraph

    return methods_paragraph(directory)


def draw_problem(
    problem: Problem, directory: Path, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Draw the training records, folds and past windows into `directory/data.png` and `.pdf`,
    levels by frequency into `response`, correlations of inputs with outputs into `delays`, and the
    problem's equations, if it has any, into `equations`.

    failed: as in `write_report`. Returns the paths written. Raises UserError when the records do
    not make folds.
    """
    from asia.report.files import write_problem

    return write_problem(problem, directory, failed)


def draw_all_boards(boards: Sequence[Board], title: str, directory: Path) -> tuple[Path, ...]:
    """Published results of benchmarks with ours among them, `directory/boards.png` and `.pdf`; none
    where no board has a published result. Returns the paths written."""
    from asia.report.files import save
    from asia.report.pictures.leaderboard import draw_boards

    shown = [board for board in boards if board.entries]
    if not shown:
        return ()
    return save(iter([("boards", lambda: draw_boards(shown, title))]), directory)


def draw_cases(cases: SimulatedCases) -> dict[str, bytes]:
    """Two pictures as PNG: `simulation`, each fold's model on the cases, and `residuals`, along the
    output, with their own past and with the inputs."""
    from asia.report.files import as_png

    return as_png(cases)


def draw_bench(pictures: BenchPictures, directory: Path) -> tuple[Path, ...]:
    """Draw a comparison of searches into `directory`, each picture as PNG and PDF.

    Returns the paths written. Raises UserError when a run named in `pictures` is not what it was.
    """
    from asia.report.pictures.bench import write_bench

    return write_bench(pictures, directory)
