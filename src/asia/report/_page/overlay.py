"""Measured against simulated outputs, as the sections show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from asia.data import Array
from asia.problem.load import Problem
from asia.report._drawing.time import time_unit
from asia.report._page.html import Html, join, tag
from asia.report._page.svg.curves import Curves, draw_curves, legend

MOST_PANELS = 6
"""Maximum number of panels of a section."""


@dataclass(frozen=True)
class Overlay:
    """Measured and simulated output over one record, block or window."""

    title: Html
    """Title of the panel."""
    alt: str
    """The same for those who do not see it."""
    channel: int
    """Number of the output."""
    first: int
    """Number of the first sample in its record."""
    measured: Array
    """(H, ny)."""
    simulated: Array
    """(H, ny)."""
    skip: int = 0
    """Samples at the start that do not count."""
    band: tuple[Array, Array] | None = None
    """Lower and upper edges (H, ny) of the output bands; None without any."""

    def cut(self, first: int, last: int) -> Overlay:
        """Return the part between two samples, counted from its start and clipped to it; at least
        two samples.
        """
        begin = min(max(first, 0), len(self.measured) - 2)
        end = max(min(last + 1, len(self.measured)), begin + 2)
        return replace(
            self,
            first=self.first + begin,
            measured=self.measured[begin:end],
            simulated=self.simulated[begin:end],
            skip=max(0, min(self.skip, end) - begin),
            band=None if self.band is None else (self.band[0][begin:end], self.band[1][begin:end]),
        )


def draw_overlays(problem: Problem, overlays: Sequence[Overlay]) -> Html:
    """The first `MOST_PANELS`, with a legend."""
    shown = [draw_overlay(problem, one) for one in overlays[:MOST_PANELS]]
    banded = any(one.band is not None for one in overlays)
    return join((overlay_legend(banded=banded), tag("div", *shown, class_="grid")))


def overlay_legend(*, banded: bool = False) -> Html:
    """Write the legend of the curves. banded: true if output bands are among them."""
    text = [("measured", "measured"), ("model", "simulated"), ("error", "difference")]
    return legend([*text, *([("outputs", "output bands")] if banded else [])])


def draw_overlay(problem: Problem, overlay: Overlay) -> Html:
    """Draw one overlay."""
    signal = problem.outputs[overlay.channel]
    end = overlay.first + len(overlay.measured)
    unit = time_unit(problem.sampling_time * end)
    step = problem.sampling_time / unit.seconds
    return draw_curves(
        Curves(
            title=overlay.title,
            alt=f"{overlay.alt}: measured and simulated {signal.name}",
            axis=f"{signal.name} [{signal.unit}]" if signal.unit else signal.name,
            time=f"time [{unit.name}]",
            start=overlay.first * step,
            step=step,
            measured=overlay.measured[:, overlay.channel],
            simulated=overlay.simulated[:, overlay.channel],
            skip=overlay.skip,
            band=None
            if overlay.band is None
            else (overlay.band[0][:, overlay.channel], overlay.band[1][:, overlay.channel]),
        )
    )
