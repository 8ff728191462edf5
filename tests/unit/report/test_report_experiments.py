"""Pictures of the experiments of a search: fronts, times, lineage, and SVG inside pages."""

from __future__ import annotations

import re

import numpy as np
from matplotlib.figure import Figure

from asia.report.drawing.inline import PANEL, svg_of
from asia.report.drawing.style import drawing, plot_line, thinned
from asia.report.pictures.experiments import (
    Span,
    Traded,
    draw_timeline,
    draw_tradeoff,
    front_of,
    without_pauses,
)
from asia.report.pictures.progress import draw_comparison


def test_searches_are_lines_of_their_own() -> None:
    searches = {f"search {k}": [[1.0, 0.5]] for k in range(9)}
    with drawing():
        (axes,) = draw_comparison(searches, {}, "rmse", "").axes
    named = [line for line in axes.get_lines() if str(line.get_label()).startswith("search")]
    assert len({(line.get_color(), line.get_linestyle()) for line in named}) == len(searches)


def test_nothing_has_less_of_both_than_a_point_of_the_front() -> None:
    rng = np.random.default_rng(0)
    many = [Traded(n, f"title {n}", *rng.uniform(0.1, 1.0, 2).tolist()) for n in range(600)]
    front = front_of(many)
    for p in many:
        beaten = [q for q in many if q.value <= p.value and q.cost <= p.cost and q is not p]
        assert (p in front) is (not beaten)
    with drawing():
        (axes,) = draw_tradeoff(many, "V", "seconds of fit").axes
        few = draw_tradeoff([*front, Traded(601, "<far>", 100.0, 5.0)], "V", "cost").axes[0]
    lines = {str(line.get_gid()): line for line in axes.get_lines()}
    assert len(lines["front"].get_xdata()) == len(front) + 1
    others = [len(line.get_xdata()) for line in axes.get_lines() if line.get_gid() == "others"]
    assert sum(others) == len(many) - len(front)
    above = {str(line.get_label()): line for line in few.get_lines()}["V above the axis"]
    assert list(above.get_ydata()) == [few.get_ylim()[1]]


def test_pauses_are_cut_and_order_and_lengths_stay() -> None:
    spans = [
        Span(1, "kept", 100.0, 110.0),
        Span(2, "other", 105.0, 125.0),
        Span(3, "other", 100_000.0, 100_005.0),
    ]
    moved = without_pauses(spans)
    assert [(one.number, one.begin, one.end) for one in moved] == [
        (1, 0.0, 10.0),
        (2, 5.0, 25.0),
        (3, 28.0, 33.0),
    ]
    with drawing():
        (axes,) = draw_timeline(spans).axes
    rows = {bar.get_gid(): bar.get_y() + bar.get_height() / 2 for bar in axes.patches}
    assert rows == {
        "bar kept experiment-1": 1.0, "bar other experiment-2": 2.0, "bar other experiment-3": 1.0,
    }  # fmt: skip


def test_an_inline_picture_is_text_of_the_page() -> None:
    """Its colours are those of the page, its words are escaped, and it repeats."""
    attack = '<script>alert(1)</script>" style="fill: #0072b2'

    def draw(number: int = 0) -> Figure:
        figure = Figure(figsize=(3.0, 2.0))
        axes = figure.subplots()
        axes.set_title(attack)
        axes.plot([0, 1, number], [0, 1, 2], "o-", color="#0072B2", gid="line")
        return figure

    svg = svg_of(draw, attack, PANEL)
    assert svg == svg_of(draw, attack, PANEL)
    assert "<script" not in svg
    assert "&lt;script&gt;" in svg
    assert re.findall(r'class="line"><path [^>]*stroke: var\(--blue\)', svg)
    assert not re.search(r"https?:|<style|<metadata|<!", svg)
    ids = set(re.findall(r' id="([^"]*)"', svg))
    assert set(re.findall(r'#([^")]*)[")]', re.sub(r"<text.*?</text>|aria-label", "", svg))) >= ids
    assert not ids & set(re.findall(r' id="([^"]*)"', svg_of(lambda: draw(1), attack, PANEL)))


def test_a_long_line_keeps_its_extremes_and_gaps() -> None:
    rng = np.random.default_rng(0)
    time, values = np.arange(10_000.0), rng.standard_normal(10_000)
    values[3000:5000] = np.nan
    _, drawn = thinned(time, values, 100)
    assert len(drawn) <= 200
    assert (np.nanmin(drawn), np.nanmax(drawn)) == (np.nanmin(values), np.nanmax(values))
    assert np.isnan(drawn).any()
    sparse = np.array([np.nan, 1.0, np.nan, 2.0, 3.0])
    axes = Figure().subplots()
    plot_line(axes, np.arange(5.0), sparse, 100, color="#000000")
    assert list(axes.get_lines()[0].get_ydata()) == [1.0]
