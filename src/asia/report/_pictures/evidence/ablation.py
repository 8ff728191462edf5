"""Picture of the ablation: contribution of each change with its interval."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from asia.ledger import Ablated
from asia.report._drawing.style import BLUE, INK, QUIET, entitle, picture_width, plain, quiet_grid
from asia.scoring import Interval

Bar = tuple[str, Interval, str]


def draw_ablation(found: Ablated, run: str, v_name: str) -> Figure:
    """The gain over the baseline in its parts, and what each change of the lineage is worth, where
    these are known."""
    bars = [*_of_crossing(found), *_of_changes(found)]
    figure = Figure(figsize=(picture_width(), 1.2 + 0.32 * max(1, len(bars))), layout="constrained")
    axes = figure.subplots()
    places = range(len(bars), 0, -1)
    for place, (_, interval, color) in zip(places, bars, strict=True):
        axes.barh(place, interval.value, height=0.62, color=color)
        if interval.high > interval.low:
            axes.plot([interval.low, interval.high], [place, place], color=INK, lw=1.2)
    axes.set_yticks(list(places), [name for name, _, _ in bars])
    axes.axvline(0.0, color=INK, lw=0.8)
    axes.set_ylim(0.3, len(bars) + 0.7)
    axes.set_xlabel(f"Decrease of {plain(v_name, 40)}")
    quiet_grid(axes)
    entitle(figure, f"{plain(run, 40)}: contributions to the gain of #{found.winner:02d}")
    return figure


def _of_crossing(found: Ablated) -> Sequence[Bar]:
    crossing = found.crossing
    if crossing is None:
        return ()
    return (
        ("gain over the baseline", crossing.gain, INK),
        ("its model alone", crossing.model, BLUE),
        ("its training alone", crossing.training, BLUE),
        ("interaction of both", crossing.interaction, BLUE),
    )


def _of_changes(found: Ablated) -> Sequence[Bar]:
    return [
        (f"the change of #{one.experiment:02d}", one.loss, QUIET)
        for one in found.left_out
        if one.loss is not None
    ]
