"""The pictures of a comparison of searches."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from asia.ledger.events import TestedModel
from asia.ledger.run import Run, open_run
from asia.problem.load import load_lock
from asia.report.comparison import BenchPictures
from asia.report.files import Picture, save, standing
from asia.report.pictures.progress import draw_arms, draw_progress
from asia.report.pictures.simulation import draw_test_horizon


def write_bench(pictures: BenchPictures, directory: Path) -> tuple[Path, ...]:
    """See `asia.report.draw_bench`."""
    return save(_pictures(pictures), directory)


def _pictures(pictures: BenchPictures) -> Iterator[Picture]:
    for name, run in pictures.progress:
        yield name, partial(_progress, run)
    for sides in pictures.sides:
        yield sides.name, partial(draw_arms, sides)
    if pictures.opened is not None:
        yield from _opened(pictures, open_run(pictures.opened))


def _opened(pictures: BenchPictures, run: Run) -> Iterator[Picture]:
    opened = run.view.unsealed
    if opened is None or not isinstance(opened.ensemble, TestedModel):
        return
    problem = load_lock(run.directory / "problem.lock.toml")
    ensemble = opened.ensemble
    yield from standing(run, problem, pictures.test_mark)
    if opened.horizon is not None:
        published, caption = pictures.mee, pictures.caption
        yield (
            "mee",
            partial(draw_test_horizon, run, problem, opened, ensemble, published, caption),
        )


def _progress(directory: Path) -> Figure:
    problem = load_lock(directory / "problem.lock.toml")
    return draw_progress(open_run(directory).view, problem.protocol.metric)
