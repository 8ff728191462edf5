"""The validation dossier: a panel a check that has something to draw."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from asia.report._drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    SHADE,
    entitle,
    panel_legend,
    plain,
    quiet_grid,
)
from asia.scoring.dossier import Check, Verdict

_COLOURS = (BLUE, ORANGE, GREEN, RED, QUIET)
_MOST_CURVES = 5
_COLUMNS = 3
# In inches.
_WIDTH = 11.0
_ROW = 2.5
_LEGEND_WIDTH = 3.2
_VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.DOUBT: ORANGE,
    Verdict.FAIL: RED,
    Verdict.SHOWN: QUIET,
    Verdict.ABSENT: QUIET,
}
_LOGARITHMIC = frozenset({"frequency response", "error spectrum"})
# Curves of so few points are marked at each.
_FEW_POINTS = 12
_MOST_LETTERS = 40


def draw_dossier(checks: Sequence[Check], title: str) -> Figure:
    """Draw the checks of a validation; of many curves in one check the first ones."""
    drawn = [check for check in checks if check.curves]
    rows = [drawn[i : i + _COLUMNS] for i in range(0, len(drawn), _COLUMNS)]
    figure = Figure(figsize=(_WIDTH, _ROW), layout="constrained")
    height = 0.7 + _ROW * len(rows)
    for panels, row in zip(figure.subplots(len(rows), _COLUMNS, squeeze=False), rows, strict=True):
        height += max(_draw(axes, check) for axes, check in zip(panels, row, strict=False))
        for axes in panels[len(row) :]:
            axes.set_visible(False)
    figure.set_figheight(height)
    entitle(figure, plain(title, 200))
    return figure


def _draw(axes: Axes, check: Check) -> float:
    """Draw one check; return the height of its legend in inches."""
    shown = check.curves[:_MOST_CURVES]
    common = _common([curve.name for curve in shown])
    for colour, curve in zip(_COLOURS, shown, strict=False):
        if curve.band is not None:
            axes.axhspan(-curve.band, curve.band, color=SHADE, lw=0, zorder=0)
        name = plain(curve.name[len(common) :], _MOST_LETTERS)
        mark = "o" if len(curve.x) <= _FEW_POINTS else ""
        axes.plot(curve.x, curve.y, color=colour, lw=1.0, marker=mark, ms=3.0, label=name)
    if check.name in _LOGARITHMIC and any((curve.y > 0).any() for curve in shown):
        _logarithmic(axes)
    elif any(curve.band is not None for curve in check.curves):
        axes.axhline(0.0, color=INK, lw=0.7)
    elif all(len(curve.x) <= _FEW_POINTS for curve in shown):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_title(f"{check.name}: {check.verdict}", color=_VERDICTS[check.verdict])
    axes.set_xlabel(check.axes[0])
    axes.set_ylabel(check.axes[1])
    quiet_grid(axes)
    if len(shown) == 1:
        return 0.0
    title = plain(common.rstrip(" ,"), _MOST_LETTERS)
    return panel_legend(axes, _LEGEND_WIDTH, fontsize=6.5, title=title or None, title_fontsize=6.5)


def _common(names: Sequence[str]) -> str:
    """Return the text before the first comma if all names share it."""
    first = names[0].partition(", ")[0] + ", "
    return first if len(names) > 1 and all(name.startswith(first) for name in names) else ""


def _logarithmic(axes: Axes) -> None:
    """Both axes, with plain numbers."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(numticks=6))
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axis.set_minor_locator(NullLocator())
