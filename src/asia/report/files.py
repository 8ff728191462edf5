"""Picture files of a run directory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from textwrap import fill

from matplotlib.figure import Figure

from asia._diagnostic import diagnostic
from asia.data.trajectory import Signal
from asia.judge.scoring.checks.check import Check
from asia.ledger.events import TestedModel
from asia.ledger.run import Run, control, metric_of, open_run
from asia.problem.check import input_delays, responses
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.problem.protocol import make_folds
from asia.report.drawing.style import DPI, drawing
from asia.report.pictures.check import draw_data, draw_delays, draw_responses
from asia.report.pictures.equations import draw_equations
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
from asia.report.simulated import SimulatedCases

Picture = tuple[str, Callable[[], Figure]]

# Metadata of a PNG and of a PDF, so that equal pictures have equal bytes.
_METADATA = ({"Software": None}, {"CreationDate": None})


def write(
    directory: Path, *, missing_only: bool = False, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """See `asia.report.write_report`."""
    run, report = open_run(directory), directory / "report"
    if not run.store.kept:
        return save(iter([progress_picture(run, metric_of(directory))]), report, failed)
    problem = load_lock(directory / "problem.lock.toml")
    drawn = pictures(run, problem)
    if missing_only:
        drawn = (one for one in drawn if not all(path.exists() for path in _files(report, one[0])))
    return save(drawn, report, failed)


def write_validation(
    directory: Path, checks: Sequence[Check], title: str, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """See `asia.report.write_dossier`."""
    drawn: Picture = ("validation", lambda: draw_validation(checks, title))
    return save(iter([drawn]), directory / "report", failed)


def write_problem(
    problem: Problem, directory: Path, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """See `asia.report.draw_problem`."""
    drawn: list[Picture] = [("data", lambda: draw_data(problem))]
    found = responses(problem)
    if any(one is not None for one in found):
        drawn.append(("response", lambda: draw_responses(problem, found)))
    delays = input_delays(problem)
    if delays:
        drawn.append(("delays", lambda: draw_delays(problem, delays)))
    physics = problem.physics
    if physics is not None:
        drawn.append(("equations", lambda: draw_equations(physics)))
    return save(iter(drawn), directory, failed)


def pictures(run: Run, problem: Problem) -> Iterator[Picture]:
    """Name and drawing of each picture the run has matter for."""
    view, metric = run.view, problem.protocol.metric
    yield progress_picture(run, metric)
    best, opened = view.best, view.unsealed
    if best is not None:
        folds = make_folds(problem.train, problem.protocol)
        yield "simulation", lambda: draw_simulation(run, problem, best, folds)
        if problem.protocol.kind == "windows":
            yield "horizon", lambda: draw_horizon(run, problem, best, folds)
        yield "residuals", lambda: draw_residuals(run, problem, best, folds)
    ablated = view.ablated
    if ablated is not None:
        yield "ablation", lambda: draw_ablation(ablated, view.started.run, view.v_name)
    if opened is None or not isinstance(opened.ensemble, TestedModel):
        return
    ensemble = opened.ensemble
    yield "test", lambda: draw_test(run, problem, opened, ensemble)
    if opened.horizon is not None:
        yield "test_horizon", lambda: draw_test_horizon(run, problem, opened, ensemble)
    yield from standing(run, problem)


def progress_picture(run: Run, metric: str) -> Picture:
    """Return the picture of the progress, which needs no artifacts."""
    view = run.view
    beside = control(run.directory, view.started, len(view.finished))
    return "progress", lambda: draw_progress(view, metric, beside)


def standing(
    run: Run, problem: Problem, mark: tuple[str, float] | None = None
) -> Iterator[Picture]:
    """The model to use among the published ones, for a benchmark that has some."""
    board = read_board(problem, run.view)
    if not board.entries or not board.standings:
        return
    name = run.view.started.run
    values = [standing.figure.value for standing in board.standings]
    if len(values) > 1:
        yield "leaderboard", lambda: draw_boards((board,), name)
        return
    output = Signal(problem.outputs[0].name, board.unit)
    yield "leaderboard", lambda: draw_standing(board.entries, values[0], output, name, mark)


def save(
    drawn: Iterator[Picture], directory: Path, failed: list[str] | None = None
) -> tuple[Path, ...]:
    """Each picture as PNG and PDF, the same bytes for the same run. A picture that cannot be drawn
    becomes a sheet with the reason, which `failed` receives too."""
    failed = [] if failed is None else failed
    directory.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for name, draw in drawn:
        with drawing():
            figure = _drawn(name, draw, failed)
            for path, metadata in zip(_files(directory, name), _METADATA, strict=True):
                stream = BytesIO()
                figure.savefig(stream, format=path.suffix[1:], dpi=DPI, metadata=metadata)
                path.write_bytes(stream.getvalue())
                paths.append(path)
    return tuple(paths)


def _drawn(name: str, draw: Callable[[], Figure], failed: list[str]) -> Figure:
    """The picture, or a sheet that says why there is none."""
    with diagnostic(f"picture {name}", failed):
        figure = draw()
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        return figure
    sheet = Figure(figsize=(6.0, 1.5))
    sheet.text(0.02, 0.5, fill(failed[-1], 80).replace("$", r"\$"), va="center")
    return sheet


def png_of(run: Run, problem: Problem, name: str, dpi: int) -> bytes:
    """Return one of the `pictures` as PNG."""
    draw = dict(pictures(run, problem))[name]
    with drawing():
        stream = BytesIO()
        draw().savefig(stream, format="png", dpi=dpi, metadata=_METADATA[0])
        return stream.getvalue()


def as_png(cases: SimulatedCases) -> dict[str, bytes]:
    """See `asia.report.draw_cases`."""
    drawn: dict[str, bytes] = {}
    for name, draw in (("simulation", draw_tried), ("residuals", draw_tried_residuals)):
        with drawing():
            figure, stream = draw(cases), BytesIO()
            figure.savefig(stream, format="png", dpi=DPI, metadata=_METADATA[0])
            drawn[name] = stream.getvalue()
    return drawn


def _files(directory: Path, name: str) -> tuple[Path, Path]:
    return directory / f"{name}.png", directory / f"{name}.pdf"
