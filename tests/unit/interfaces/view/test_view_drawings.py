"""The curve of a long search on the page."""

from __future__ import annotations

import re

import numpy as np
import pytest

from asia.report.page.svg import (
    NARROW,
    WIDE,
    BestSoFar,
    Point,
    Span,
    Traded,
    draw_best,
    draw_progress,
    draw_timeline,
    draw_tradeoff,
    front_of,
    without_pauses,
)


def points(count: int) -> list[Point]:
    """Every tenth is kept, every seventh of the others fails."""
    found: list[Point] = []
    for n in range(1, count + 1):
        kept = n % 10 == 1
        value = None if not kept and n % 7 == 0 else (1.0 if kept else 1.2) / n**0.2
        status = "keep" if kept else "discard" if value else "invalid"
        found.append(Point(n, value, status, f"title {n}", status == "keep"))
    return found


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_every_experiment_of_a_long_search_is_drawn(size) -> None:
    many = points(1000)
    drawn = draw_progress(many, [], "V", "alt", size)
    kept = [p for p in many if p.status == "keep"]
    failed = [p for p in many if p.value is None]
    assert drawn.count('class="kept"') == len(kept)
    assert drawn.count("h0") == len(many) - len(kept) - len(failed)
    assert drawn.count("v7") == len(failed)
    assert "title 991" in drawn or size is NARROW


def test_each_experiment_of_a_short_search_has_its_title() -> None:
    drawn = draw_progress(points(100), [], "V", "alt", WIDE)
    assert drawn.count("<title>") == 100
    assert "h0" not in drawn


def test_searches_are_lines_of_their_own() -> None:
    first = BestSoFar("<first>", ((1, 1.0), (4, 0.5)), 8)
    drawn = draw_best([first, BestSoFar("none", (), 0)], "V", "alt", WIDE)
    assert drawn.count('class="line steps series0 dash0"') == 1
    assert 'class="line steps series1' not in drawn
    assert "&lt;first&gt;" in drawn
    six = draw_best([first] * 5 + [BestSoFar("other", ((1, 20.0),), 2)], "V", "alt", WIDE)
    assert 'class="line steps series4 dash0"' in six
    assert 'class="line steps series0 dash1"' in six


def test_nothing_has_less_of_both_than_a_point_of_the_front() -> None:
    rng = np.random.default_rng(0)
    many = [Traded(n, f"title {n}", *rng.uniform(0.1, 1.0, 2).tolist()) for n in range(600)]
    front = front_of(many)
    for p in many:
        beaten = [q for q in many if q.value <= p.value and q.cost <= p.cost and q is not p]
        assert (p in front) is (not beaten)
    drawn = draw_tradeoff(many, "V", "seconds of fit", "alt", WIDE)
    assert drawn.count('class="kept"') == len(front)
    assert drawn.count("h0") == len(many) - len(front)
    few = draw_tradeoff([*front, Traded(601, "<far>", 100.0, 5.0)], "V", "cost", "alt", NARROW)
    assert few.count("<title>") == len(front) + 1
    assert few.count("h10l-5 -9z") == 1
    assert "&lt;far&gt;" in few


@pytest.mark.parametrize("seed", range(5))
def test_names_of_the_trade_off_picture_lie_over_no_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Close above the front, where the names are.
    costs = rng.uniform(0.1, 1.0, 40)
    values = 0.1 / costs * rng.choice([1.0, 1.1, 1.3], 40)
    many = [
        Traded(n, "a long title of a candidate", float(value), float(cost))
        for n, (value, cost) in enumerate(zip(values, costs, strict=True))
    ]
    drawn = draw_tradeoff(many, "V", "seconds of fit", "alt", WIDE)
    points = [tuple(map(float, one)) for one in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', drawn)]
    names = re.findall(r'<text x="([\d.]+)" y="([\d.]+)"[^>]*class="tag">([^<]*)<', drawn)
    assert (len(points), len(names) > 1) == (len(many), True)
    for left, base, name in names:
        x, y = float(left), float(base)
        # Characters of this size are at least 5 wide and 9 high.
        over = [p for p in points if x < p[0] < x + 5 * len(name) and y - 9 < p[1] < y]
        assert over == [], name


def test_pauses_are_cut_and_order_and_lengths_stay() -> None:
    spans = [
        Span(1, "one", "kept", 100.0, 110.0),
        Span(2, "two", "other", 105.0, 125.0),
        Span(3, "three", "other", 100_000.0, 100_005.0),
    ]
    moved = without_pauses(spans)
    assert [(one.number, one.begin, one.end) for one in moved] == [
        (1, 0.0, 10.0),
        (2, 5.0, 25.0),
        (3, 28.0, 33.0),
    ]
    drawn = draw_timeline(spans, "alt", WIDE)
    rows = re.findall(r'<rect [^>]*y="(\d+)"', drawn)
    assert rows == ["8", "24", "8"]
