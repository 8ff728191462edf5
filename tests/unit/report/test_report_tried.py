"""Pictures of simulated cases: panels, pieces, bins."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from asia.data import Signal
from asia.data.segment import Segment, SimulatedSegment
from asia.ledger.simulated import SimulatedCases
from asia.report.drawing.style import drawing
from asia.report.pictures.evidence import draw_tried, draw_tried_residuals

from .test_report_pictures import assert_readable


def cases(*, windows: bool = False, outputs: int = 1, held_out: bool = False) -> SimulatedCases:
    random = np.random.default_rng(0)
    found: list[tuple[int, bool, SimulatedSegment]] = []
    for fold in (1, 2):
        for out in (False, True) if held_out else (False,):
            for k in range(5 if windows else 1):
                u = random.normal(size=(80, 1))
                y_hat = random.uniform(1.0, 3.0, (80, outputs))
                y = y_hat + 0.1 * (y_hat - 2.0) ** 2 * np.arange(1, outputs + 1)
                block = Segment(u[:0], y[:0], u, y, "run", start=80 * k)
                found.append((fold, out, block.simulated(y_hat)))
    signals = tuple(Signal(f"y{k}", "m") for k in range(outputs))
    return SimulatedCases(
        "Experiment 7, a try", 0.5, windows, (Signal("u"),), signals, tuple(found)
    )


def drawn(shown: SimulatedCases) -> tuple[Figure, Figure]:
    with drawing():
        figures = draw_tried(shown), draw_tried_residuals(shown)
        for figure in figures:
            assert_readable(figure)
        return figures


@pytest.mark.parametrize("windows", [False, True])
def test_a_panel_for_each_fold_and_output(windows: bool) -> None:
    simulation, residuals = drawn(cases(windows=windows, outputs=2))
    titles = [axes.get_title(loc="left") for axes in simulation.axes[::2]]
    assert [title.split("\n")[0] for title in titles] == [
        "Fold 1, training, y0", "Fold 2, training, y0", "Fold 1, training, y1",
        "Fold 2, training, y1",
    ]  # fmt: skip
    assert len(residuals.axes) == 2 * 3
    assert residuals.axes[0].get_title(loc="left") == "residual along the output"


def test_the_bins_show_the_curve() -> None:
    """y - y_hat = (y_hat - 2)^2 / 10, so the means are large at both ends and none in between."""
    residuals = drawn(cases())[1]
    bars = residuals.axes[0].containers[0]
    means = bars.lines[0].get_ydata()
    assert means[0] > 0.06
    assert means[-1] > 0.06
    assert abs(means[len(means) // 2]) < 0.01


def test_held_out_parts_stand_beside_the_training() -> None:
    simulation, residuals = drawn(cases(held_out=True))
    titles = [axes.get_title(loc="left").split(":")[0] for axes in simulation.axes[::2]]
    assert titles == [
        "Fold 1, training",
        "Fold 1, held out",
        "Fold 2, training",
        "Fold 2, held out",
    ]
    assert "residuals of the held-out part" in residuals.get_suptitle()


@pytest.mark.slow
def test_many_outputs_are_chosen_by_their_residual() -> None:
    simulation, residuals = drawn(cases(outputs=6))
    assert "4 of 6 outputs" in simulation.get_suptitle()
    assert len(residuals.axes) == 4 * 3
    assert [axes.get_ylabel().split("\n")[0] for axes in residuals.axes[::3]] == [
        "y2", "y3", "y4", "y5",
    ]  # fmt: skip


def test_a_missing_held_out_panel_is_explained_and_means_have_units() -> None:
    simulation, _ = drawn(cases())
    assert "training part (the held-out part is not shown)" in simulation.get_suptitle()
    assert simulation.axes[0].get_title(loc="left").endswith(" m")
    assert "not shown" not in drawn(cases(held_out=True))[0].get_suptitle()
