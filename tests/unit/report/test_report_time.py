from __future__ import annotations

import numpy as np
import pytest

from asia.report.drawing.places import Stretch, TimeUnit, last_sample, lay_out, time_unit

SECONDS = TimeUnit("s", 1.0)


@pytest.mark.parametrize(
    ("span", "name"), [(0.2, "ms"), (30.0, "s"), (4096.0, "min"), (90000.0, "h")]
)
def test_the_unit_fits_the_span(span: float, name: str) -> None:
    assert time_unit(span).name == name


def test_a_single_stretch_keeps_the_time_of_its_record() -> None:
    axis = lay_out([Stretch(515, 4)], 4.0, TimeUnit("min", 60.0))
    np.testing.assert_allclose(axis.times[0], np.array([2060.0, 2064.0, 2068.0, 2072.0]) / 60.0)
    assert axis.label == "Time [min]"
    assert axis.seams == ()


def test_several_stretches_lie_end_to_end_with_a_gap() -> None:
    axis = lay_out([Stretch(100, 50), Stretch(7, 50)], 1.0, SECONDS)
    assert axis.times[0][0] == 0.0
    assert axis.times[0][-1] < axis.seams[0] < axis.times[1][0]
    assert axis.times[1][0] - axis.times[0][-1] > 1.0
    assert "end to end" in axis.label
    assert last_sample([Stretch(100, 50), Stretch(7, 50)]) == 100
