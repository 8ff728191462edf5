"""The validation dossier: a panel a check that has something to draw."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asia.report._drawing.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    QUIET,
    RED,
    SHADE,
    entitle,
    plain,
    quiet_grid,
)
from asia.scoring.dossier import Check, Verdict

_COLOURS = (BLUE, ORANGE, GREEN, RED, QUIET)
_MOST_CURVES = 5
_COLUMNS = 3
_VERDICTS = {
    Verdict.PASS: GREEN,
    Verdict.DOUBT: ORANGE,
    Verdict.FAIL: RED,
    Verdict.SHOWN: QUIET,
    Verdict.ABSENT: QUIET,
}
_LOGARITHMIC = frozenset({"frequency response", "error spectrum"})


def draw_dossier(checks: Sequence[Check], title: str) -> Figure:
    """Of many curves in one check the first ones."""
    drawn = [check for check in checks if check.curves]
    rows = -(-len(drawn) // _COLUMNS)
    figure = Figure(figsize=(11.0, 0.7 + 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel().tolist()
    for axes, check in zip(panels, drawn, strict=False):
        _draw(axes, check)
    for axes in panels[len(drawn) :]:
        axes.set_visible(False)
    entitle(figure, plain(title, 200))
    return figure


def _draw(axes: Axes, check: Check) -> None:
    for colour, curve in zip(_COLOURS, check.curves[:_MOST_CURVES], strict=False):
        if curve.band is not None:
            axes.axhspan(-curve.band, curve.band, color=SHADE, lw=0, zorder=0)
        axes.plot(curve.x, curve.y, color=colour, lw=1.0, label=plain(curve.name, 34))
    if check.name in _LOGARITHMIC:
        axes.set_xscale("log")
        axes.set_yscale("log")
    elif any(curve.band is not None for curve in check.curves):
        axes.axhline(0.0, color=INK, lw=0.7)
    axes.set_title(f"{check.name}: {check.verdict}", color=_VERDICTS[check.verdict])
    axes.set_xlabel(check.axes[0])
    axes.set_ylabel(check.axes[1])
    if len(check.curves) > 1:
        axes.legend(fontsize=6.0)
    quiet_grid(axes)
