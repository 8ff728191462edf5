"""Published results of several benchmarks, and ours among them, in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from asia.report._board import Board
from asia.report._drawing.style import BLUE, QUIET, RED, entitle, picture_width, plain, quiet_grid

_ROW = 0.24
_MARGINS = 1.1
# Results beyond this many times the best are drawn at the edge.
_WORST = 1_000.0


@dataclass(frozen=True)
class _Row:
    label: str
    published: tuple[float, ...]
    ours: float | None
    words: str


def draw_boards(boards: Sequence[Board], title: str) -> Figure:
    """A row for each official figure: published test RMSE over the lowest of them, and ours where
    the test was opened. boards: with one published result or more each."""
    rows = [row for board in boards for row in _rows(board)]
    figure = Figure(figsize=(picture_width(), _MARGINS + _ROW * len(rows)), layout="constrained")
    axes = figure.subplots()
    _draw(axes, rows)
    entitle(figure, title if len(title) < 70 else plain(title, 70))
    figure.supxlabel(
        "Published: nonlinearbenchmark.org; red: the model to use, where the test was opened",
        x=0.01,
        ha="left",
        fontsize=7.0,
        color=QUIET,
    )
    return figure


def _rows(board: Board) -> list[_Row]:
    found: list[_Row] = []
    for index, name in enumerate(board.names):
        values = [e.figures[index] for e in board.entries if index < len(e.figures)]
        published = tuple(sorted(v for v in values if v is not None))
        if not published:
            continue
        ours = board.standings[index] if index < len(board.standings) else None
        label = board.problem if len(board.names) == 1 else f"{board.problem}: {name}"
        text = f"best {published[0]:g} {board.unit}"
        if ours is not None:
            text += f", ours {ours.figure.value:.3g}: {ours.rank} of {ours.among}"
        found.append(_Row(label, published, ours.figure.value if ours else None, text))
    return found


def _draw(axes: Axes, rows: Sequence[_Row]) -> None:
    for y, row in enumerate(rows):
        best = row.published[0]
        ratios = [min(v / best, _WORST) for v in row.published]
        axes.plot(ratios, [y] * len(ratios), "o", mfc="white", mec=BLUE, ms=4.0, mew=0.9)
        if row.ours is not None:
            ratio = min(max(row.ours / best, 1 / _WORST), _WORST)
            axes.plot([ratio], [y], "D", color=RED, ms=6.0, zorder=5)
        axes.annotate(
            row.words,
            xy=(1.01, y),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.0,
            color=QUIET if row.ours is None else RED,
            annotation_clip=False,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(rows)), [plain(row.label, 44) for row in rows], fontsize=7.0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.axvline(1.0, color=QUIET, lw=0.8, dashes=(3, 2), zorder=0)
    axes.set_xlabel("Test RMSE / lowest published one")
    quiet_grid(axes)
