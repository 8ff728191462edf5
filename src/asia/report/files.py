"""Picture files of runs, problems and comparisons."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from asia._diagnostic import diagnostic
from asia._progress import tracked
from asia.agents.expert_result import expert_result
from asia.data.trajectory import Signal
from asia.judge.scoring.checks.check import Check, CheckCurve
from asia.ledger.chain import write_whole
from asia.ledger.events import TestedModel
from asia.ledger.evidence import get_curves
from asia.ledger.run import Run, metric_of, open_run
from asia.ledger.simulated import SimulatedCases
from asia.presentation.results import validation_text
from asia.problem.check import input_delays, responses
from asia.problem.folds import make_folds
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.report.drawing.style import DPI, drawing
from asia.report.pictures.check import draw_data, draw_delays, draw_responses
from asia.report.pictures.evidence import (
    draw_ablation,
    draw_residuals,
    draw_tried,
    draw_tried_residuals,
    draw_validation,
)
from asia.report.pictures.leaderboard import draw_boards, draw_standing
from asia.report.pictures.progress import draw_progress
from asia.report.pictures.simulation import (
    draw_horizon,
    draw_simulation,
    draw_test,
    draw_test_horizon,
)
from asia.report.published import read_board

Picture = tuple[str, Callable[[], Figure]]
"""Name of the files and the function that draws."""

COLUMN: Final = 3.5
"""Width of a column, in inches: 88.9 mm, as IEEE and Elsevier have it."""
PAGE: Final = 7.16
"""Width of a page with two columns, in inches: 181.9 mm."""

# Without date and version: equal pictures have equal bytes.
_METADATA: Final[dict[str, dict[str, Any]]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
    "png": {"Software": None},
}


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
    run, report = open_run(directory), directory / "report"
    if not run.store.kept:
        return save([_progress(run, metric_of(directory))], report, failed)
    drawn = pictures(run, load_lock(directory / "problem.lock.toml"))
    if missing_only:
        drawn = (
            (name, draw)
            for name, draw in drawn
            if not all((report / f"{name}.{kind}").exists() for kind in ("png", "pdf"))
        )
    return save(drawn, report, failed)


def write_validation(
    directory: Path, checks: Sequence[Check], title: str, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Draw the checks of a validation report into `<directory>/report` as validation.png and
    validation.pdf.
    failed: as in `write_report`. Returns the paths written."""
    drawn: Picture = ("validation", lambda: draw_validation(checks, title))
    return save([drawn], directory / "report", failed)


def draw_problem(
    problem: Problem, directory: Path, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Draw the training records, folds and past windows into `directory/data.png` and `.pdf`,
    levels by frequency into `response`, correlations of inputs with outputs into `delays`, and the
    problem's equations, if it has any, into `equations`.

    failed: as in `write_report`. Returns the paths written. Raises UserError when the records do
    not make folds.
    """
    drawn: list[Picture] = [("data", lambda: draw_data(problem))]
    found = responses(problem)
    if any(one is not None for one in found):
        drawn.append(("response", lambda: draw_responses(problem, found)))
    delays = input_delays(problem)
    if delays:
        drawn.append(("delays", lambda: draw_delays(problem, delays)))
    physics = problem.physics
    if physics is not None:
        from asia.report.pictures.equations import draw_equations  # SymPy takes half a second

        drawn.append(("equations", lambda: draw_equations(physics)))
    return save(drawn, directory, failed)


def draw_cases(cases: SimulatedCases) -> dict[str, bytes]:
    """Two pictures as PNG: `simulation`, each fold's model on the cases, and `residuals`, along the
    output, with their own past and with the inputs."""
    with drawing():
        return {
            "simulation": _encoded(draw_tried(cases), "png"),
            "residuals": _encoded(draw_tried_residuals(cases), "png"),
        }


def write_figures(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """The pictures of a run for a paper, into `directory`, each as PDF, SVG and PNG: as wide as a
    column (3.5 inches) where the picture has one column of panels, else as a page with two columns
    (7.16 inches). Returns the paths written. Raises UserError as `write_report`."""
    run = open_run(run_directory)
    drawn = [_progress(run, metric_of(run_directory))]
    if run.store.kept:
        drawn = [*pictures(run, load_lock(run_directory / "problem.lock.toml")), *_validations(run)]
    directory.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for name, draw in drawn:
        with drawing(_paper_width(draw)):
            figure = draw()
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
            for kind in _METADATA:
                path = directory / f"{name}.{kind}"
                write_whole(path, _encoded(figure, kind, 300), durable=False)
                paths.append(path)
    return tuple(paths)


def _paper_width(draw: Callable[[], Figure]) -> float:
    """The width of one column of panels with which the picture is as wide as a column, else as a
    page."""
    wide = COLUMN
    for width in (COLUMN, PAGE):
        with drawing(width):
            wide = draw().get_figwidth()
        if abs(wide - width) < 0.01:
            return width
    return PAGE * PAGE / wide


def _validations(run: Run) -> Iterator[Picture]:
    """Yield the pictures of the validation of the folds and of each new record in the ledger."""
    for place, found in enumerate(run.view.validated):
        recorded = {one.name: one for one in found.checks}
        checks = [
            Check(
                drawn.name,
                recorded[drawn.name].verdict,
                recorded[drawn.name].sentence,
                curves=tuple(
                    CheckCurve(one.name, np.array(one.x), np.array(one.y), one.band)
                    for one in drawn.curves
                ),
                axes=drawn.axes,
            )
            for drawn in get_curves(run.store, found.curves)
        ]
        name = "validation" if place == 0 else f"validation-{place + 1}"
        yield name, partial(draw_validation, checks, validation_text(found))


def pictures(run: Run, problem: Problem) -> Iterator[Picture]:
    """Name and drawing of each picture the run has matter for."""
    view, metric = run.view, problem.protocol.metric
    yield _progress(run, metric)
    best, opened, ablated = view.best, view.unsealed, view.ablated
    if best is not None:
        folds = make_folds(problem.train, problem.protocol)
        yield "simulation", lambda: draw_simulation(run, problem, best, folds)
        if problem.protocol.kind == "windows":
            yield "horizon", lambda: draw_horizon(run, problem, best, folds)
        if problem.protocol.kind != "control":
            yield "residuals", lambda: draw_residuals(run, problem, best, folds)
    if ablated is not None:
        yield "ablation", lambda: draw_ablation(ablated, view.started.run, view.v_name)
    if opened is None or not isinstance(opened.ensemble, TestedModel):
        return
    ensemble = opened.ensemble
    yield "test", lambda: draw_test(run, problem, opened, ensemble)
    if opened.horizon is not None:
        yield "test_horizon", lambda: draw_test_horizon(run, problem, opened, ensemble)
    yield from _standing(run, problem)


def _progress(run: Run, metric: str) -> Picture:
    """Picture of the progress, which needs no artifacts."""
    view = run.view
    beside = expert_result(run.directory, view.started, len(view.finished))
    return "progress", lambda: draw_progress(view, metric, beside)


def _standing(run: Run, problem: Problem) -> Iterator[Picture]:
    """The model to use among the published ones, for a benchmark that has some."""
    board = read_board(problem, run.view)
    if not board.entries or not board.standings:
        return
    name = run.view.started.run
    values = [standing.figure.value for standing in board.standings]
    output = Signal(problem.outputs[0].name, board.unit)
    if len(values) > 1:
        yield "leaderboard", lambda: draw_boards((board,), name)
    else:
        yield "leaderboard", lambda: draw_standing(board.entries, values[0], output, name)


def save(
    drawn: Iterable[Picture], directory: Path, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Each picture as PNG and PDF, the same bytes for the same run. A picture that cannot be drawn
    becomes a sheet with the reason, which `failed` receives too."""
    failed = [] if failed is None else failed
    directory.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for name, draw in tracked(tuple(drawn), "picture"):
        with drawing():
            figure, before = Figure(figsize=(6.0, 1.5)), len(failed)
            with diagnostic(f"picture {name}", failed):
                figure = draw()
                figure.draw_without_rendering()
                figure.set_layout_engine("none")
            if len(failed) > before:
                figure = Figure(figsize=(6.0, 1.5))
                text = fill(failed[-1], 80).replace("$", r"\$")
                figure.text(0.02, 0.5, text, va="center")
            for kind in ("png", "pdf"):
                path = directory / f"{name}.{kind}"
                path.write_bytes(_encoded(figure, kind))
                paths.append(path)
    return tuple(paths)


def png_of(run: Run, problem: Problem, name: str, dpi: int) -> bytes:
    """Return one of the `pictures` as PNG."""
    draw = dict(pictures(run, problem))[name]
    with drawing():
        return _encoded(draw(), "png", dpi)


def _encoded(figure: Figure, kind: str, dpi: int = DPI) -> bytes:
    stream = BytesIO()
    figure.savefig(stream, format=kind, dpi=dpi, metadata=_METADATA[kind])
    return stream.getvalue()
