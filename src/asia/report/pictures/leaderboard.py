"""Pictures of published results with our own among them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from asia.data.trajectory import Array, Signal
from asia.report.drawing.style import (
    BLUE,
    INK,
    QUIET,
    RED,
    SHADE,
    entitle,
    picture_width,
    plain,
    quantity,
    quiet_grid,
)
from asia.report.published import Board, Entry

# Published results of several benchmarks, and ours among them, in one picture.


_ROW = 0.24
_MARGINS = 1.1
# Results beyond this many times the best are drawn at the edge.
_WORST = 1_000.0


def draw_boards(boards: Sequence[Board], title: str) -> Figure:
    """A row for each official figure: published test RMSE over the lowest of them, and ours where
    the test was opened. boards: with one published result or more each."""
    rows = [
        (board, index, published)
        for board in boards
        for index in range(len(board.names))
        if (published := _published(board, index))
    ]
    figure = Figure(figsize=(picture_width(), _MARGINS + _ROW * len(rows)), layout="constrained")
    axes = figure.subplots()
    labels: list[str] = []
    for y, (board, index, published) in enumerate(rows):
        best = published[0]
        ours = board.standings[index] if index < len(board.standings) else None
        one = len(board.names) == 1
        labels.append(board.problem if one else f"{board.problem}: {board.names[index]}")
        text, color = f"best {best:g} {board.unit}", QUIET
        ratios = [min(v / best, _WORST) for v in published]
        axes.plot(ratios, [y] * len(ratios), "o", mfc="white", mec=BLUE, ms=4.0, mew=0.9)
        if ours is not None:
            text += f", ours {ours.figure.value:.3g}: {ours.rank} of {ours.among}"
            color, ratio = RED, ours.figure.value / best
            axes.plot([min(max(ratio, 1 / _WORST), _WORST)], [y], "D", color=RED, ms=6.0, zorder=5)
        axes.annotate(
            text,
            xy=(1.01, y),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.0,
            color=color,
            annotation_clip=False,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(rows)), [plain(label, 44) for label in labels], fontsize=7.0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.axvline(1.0, color=QUIET, lw=0.8, dashes=(3, 2), zorder=0)
    axes.set_xlabel("Test RMSE / lowest published one")
    quiet_grid(axes)
    entitle(figure, title if len(title) < 70 else plain(title, 70))
    sources = "Published: nonlinearbenchmark.org; red: the model to use, where the test was opened"
    figure.supxlabel(sources, x=0.01, ha="left", fontsize=7.0, color=QUIET)
    return figure


def _published(board: Board, index: int) -> list[float]:
    values = [e.figures[index] for e in board.entries if index < len(e.figures)]
    return sorted(v for v in values if v is not None)


# Our test error among the published ones: box plot and histogram.


def draw_standing(entries: Sequence[Entry], ours: float, output: Signal, run: str) -> Figure:
    """Published test RMSE with our mark. ours: test RMSE in the unit of `output`."""
    values = np.array([e.test_rmse for e in entries])
    figure = Figure(figsize=(picture_width(), 3.1), layout="constrained")
    box, bars = figure.subplots(1, 2, width_ratios=(1.0, 2.1))
    label = f"Test RMSE [{plain(output.unit, 16)}]" if output.unit else "Test RMSE"
    _box(box, values, ours)
    box.set_ylabel(label)
    _histogram(bars, values, ours, quantity(ours, output.unit))
    bars.set_xlabel(label)
    lower, many = int((values < ours).sum()), len(values)
    entitle(figure, f"{plain(run, 40)}: {lower} of {many} published results have a lower test RMSE")
    first, last = min(e.year for e in entries), max(e.year for e in entries)
    sources = f"Published: {many} results from {first} to {last}, nonlinearbenchmark.org"
    figure.supxlabel(sources, x=0.01, ha="left", fontsize=7.0, color=QUIET)
    return figure


def _box(axes: Axes, values: Array, ours: float) -> None:
    line = {"color": INK, "linewidth": 0.9}
    axes.boxplot(
        values,
        widths=0.4,
        whis=1.5,
        showfliers=False,
        patch_artist=True,
        boxprops={"facecolor": SHADE, "edgecolor": INK, "linewidth": 0.9},
        medianprops={"color": INK, "linewidth": 1.6},
        whiskerprops=line,
        capprops=line,
    )
    axes.plot(_beside(values), values, "o", mfc="white", mec=BLUE, ms=4.0, mew=0.9, zorder=3)
    axes.plot([1.0], [ours], "D", color=RED, ms=7.0, zorder=5)
    axes.set_xlim(0.6, 1.7)
    axes.set_ylim(0.0, max(values.max(), ours) * 1.08)
    axes.set_xticks([])
    quiet_grid(axes)


def _histogram(axes: Axes, values: Array, ours: float, mark: str) -> None:
    top, width = max(values.max(), ours), _bin_width(values)
    axes.hist(
        values, np.arange(0.0, top + 2 * width, width).tolist(), fc="#9fc3dd", ec="white", lw=0.8
    )
    axes.axvline(ours, color=RED, lw=1.6, dashes=(4, 2))
    axes.plot([ours], [0.0], "D", color=RED, ms=7.0, clip_on=False, zorder=5)
    axes.set_xlim(0.0, top * 1.05)
    axes.set_ylabel("Published results")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    quiet_grid(axes)
    left = ours < 0.7 * top
    axes.annotate(
        f"this run\n{mark}",
        xy=(ours, 0.97),
        xycoords=("data", "axes fraction"),
        xytext=(6.0 if left else -6.0, 0.0),
        textcoords="offset points",
        ha="left" if left else "right",
        va="top",
        color=RED,
        fontweight="bold",
        bbox={"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85},
    )


def _beside(values: Array) -> list[float]:
    """x positions right of the box that keep close values apart."""
    reach = (values.max() - values.min()) / 25.0
    placed: list[tuple[float, float]] = []
    columns: dict[int, float] = {}
    for index in np.argsort(values, kind="stable"):
        value, x = float(values[index]), 1.3
        while any(abs(value - v) < reach and x == at for v, at in placed):
            x = round(x + 0.07, 2)
        placed.append((value, x))
        columns[int(index)] = x
    return [columns[i] for i in range(len(values))]


def _bin_width(values: Array) -> float:
    """Freedman and Diaconis (1981), rounded to 1, 2 or 5 times a power of ten."""
    spread = np.subtract(*np.percentile(values, [75, 25])) or values.max()
    width = 2.0 * spread / len(values) ** (1 / 3)
    power = 10.0 ** np.floor(np.log10(width))
    return float(min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(m * power - width)) * power)
