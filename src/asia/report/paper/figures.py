"""The pictures of a run as figures of a paper: PDF, SVG and PNG as wide as a column or a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from asia.judge.scoring.checks.check import Check, CheckCurve
from asia.ledger.chain import write_whole
from asia.ledger.evidence import DrawnCurve, get_curves
from asia.ledger.run import Run, metric_of, open_run
from asia.problem.load import load_lock
from asia.report.drawing.style import drawing
from asia.report.files import Picture, pictures, progress_picture
from asia.report.pictures.evidence import draw_validation

COLUMN: Final = 3.5
"""Width of a column, in inches: 88.9 mm, as IEEE and Elsevier have it."""
PAGE: Final = 7.16
"""Width of a page with two columns, in inches: 181.9 mm."""
_PNG_DPI: Final = 300
# Metadata without date and version, ids from a fixed salt: the file depends only on the picture.
_METADATA: Final[dict[str, dict[str, Any]]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
    "png": {"Software": None},
}


def write_figures(run_directory: Path, directory: Path) -> tuple[Path, ...]:
    """See `asia.report.write_figures`."""
    run = open_run(run_directory)
    if run.store.kept:
        drawn = [
            *pictures(run, load_lock(run_directory / "problem.lock.toml")),
            *_dossiers(run),
        ]
    else:
        drawn = [progress_picture(run, metric_of(run_directory))]
    directory.mkdir(parents=True, exist_ok=True)
    return tuple(path for name, draw in drawn for path in _save(name, draw, directory))


def _dossiers(run: Run) -> Iterator[Picture]:
    """Yield the pictures of the validation of the folds and of each new record in the ledger."""
    for place, found in enumerate(run.view.validated):
        checks = {one.name: one for one in found.checks}
        checks = tuple(
            Check(
                drawn.name,
                checks[drawn.name].verdict,
                checks[drawn.name].sentence,
                curves=tuple(_curve(one) for one in drawn.curves),
                axes=drawn.axes,
            )
            for drawn in get_curves(run.store, found.curves)
        )
        counts = f"pass {found.passed}, doubt {found.doubtful}, fail {found.failed}"
        name = "validation" if place == 0 else f"validation-{place + 1}"
        yield name, partial(draw_validation, checks, counts)


def _curve(one: DrawnCurve) -> CheckCurve:
    return CheckCurve(one.name, np.array(one.x), np.array(one.y), one.band)


def _width(draw: Callable[[], Figure]) -> float:
    """The width of one column of panels with which the picture is as wide as a column, else as a
    page."""
    wide = COLUMN
    for width in (COLUMN, PAGE):
        with drawing(width):
            wide = draw().get_figwidth()
        if abs(wide - width) < 0.01:
            return width
    return PAGE * PAGE / wide


def _save(name: str, draw: Callable[[], Figure], directory: Path) -> list[Path]:
    paths: list[Path] = []
    width = _width(draw)
    with drawing(width), rc_context({"svg.hashsalt": "asia", "svg.fonttype": "none"}):
        figure = draw()
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for kind, metadata in _METADATA.items():
            stream = BytesIO()
            figure.savefig(stream, format=kind, dpi=_PNG_DPI, metadata=metadata)
            path = directory / f"{name}.{kind}"
            write_whole(path, stream.getvalue(), durable=False)
            paths.append(path)
    return paths
