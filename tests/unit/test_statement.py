"""A value is stated as far as its interval carries it."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from asia._statement import NOT_IDENTIFIABLE, fit_note, stated


@given(
    value=st.floats(1e-6, 1e6),
    low=st.floats(0.0, 1.0, exclude_max=True),
    ratio=st.floats(1.0, 1e6),
    size=st.floats(1e-9, 1e9),
)
def test_a_statement_does_not_depend_on_the_unit(
    value: float, low: float, ratio: float, size: float
) -> None:
    ends = value * low, value * ratio
    one = stated(value, ends, positive=True)
    other = stated(size * value, (size * ends[0], size * ends[1]), positive=True)
    apart = abs(ends[1] - 10.0 * ends[0]) > 1e-9 * ends[1]
    assert (one.value is None) == (other.value is None) or not apart
    if one.value is None:
        assert one.reason == NOT_IDENTIFIABLE
        assert str(one) == f"none: {NOT_IDENTIFIABLE}"


def test_intervals_without_content_values_at_bounds_and_reasons() -> None:
    for ends in ((1.6e-25, 6.9e23), (0.0, math.inf), (math.nan, 1.0)):
        assert stated(1.0, ends, "s", positive=True).reason == NOT_IDENTIFIABLE
    edge = stated(5.0, (1.0, 5.0), "s", at_bound="upper")
    assert (edge.interval, str(edge)) == (None, "5 s (at the upper end of its range)")
    assert str(stated(2.0, (1.9, 2.1), "K/kW")) == "2 K/kW (1.9 to 2.1)"
    assert str(stated(2.0, None, reason="the plant integrates")) == "none: the plant integrates"
    assert "61 %, below 80 %" in fit_note(61.2)
    assert fit_note(80.0) == fit_note(None) == ""
