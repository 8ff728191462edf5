"""The simulated hysteretic oscillator."""

from __future__ import annotations

import numpy as np
import pytest

from asia.data import Signal
from asia.data.sources import Channels
from asia.data.sources.simulated import bouc_wen
from asia.data.sources.simulated.source import Simulated
from asia.testing import check_source

CHANNELS = Channels((Signal("force"),), (Signal("displacement"),), 1 / 750)


@pytest.mark.slow
def test_it_is_a_source() -> None:
    check_source(lambda: Simulated(0, 1, "bouc_wen"), CHANNELS)


def test_it_is_excited_as_published_and_measured_with_noise() -> None:
    found = Simulated(0, 0, "bouc_wen").records("train", CHANNELS)
    assert found.truth is not None
    for record, truth in zip(found.trajectories, found.truth, strict=True):
        power = np.abs(np.fft.rfft(record.u[:, 0])) ** 2
        hertz = np.fft.rfftfreq(len(record), 1 / 750)
        assert power[(hertz < 4.9) | (hertz > 150)].sum() < 1e-9 * power.sum()
        assert abs(record.u.std() - 50) < 0.01
        assert abs((record.y - truth).std() / 8e-6 - 1) < 0.05
    names = [t.name for t in Simulated(0, 0, "bouc_wen").records("test", CHANNELS).trajectories]
    assert names == ["multisine_test", "sweep_test"]


def test_at_small_force_both_stiffnesses_carry_the_force() -> None:
    """A constant force meets both stiffnesses while the hysteresis has no losses."""
    force = np.full(16 * 3000 + 1, 1e-3)
    rest = bouc_wen._displacement(force)[-1]
    assert abs(rest / (1e-3 / 1e5) - 1) < 1e-3


def test_a_loop_of_force_and_displacement_stays_open_when_it_is_slow() -> None:
    """Work is lost in each cycle, more than the damper takes."""
    cycles, hertz = 4, 1.0
    steps = round(cycles * 750 / hertz) * 16 + 1
    time = np.arange(steps) / (750 * 16)
    force = 100 * np.sin(2 * np.pi * hertz * time)
    y = bouc_wen._displacement(force)
    u = force[:-1:16]
    last = slice(len(y) - round(750 / hertz), None)
    work = float(np.sum(u[last][:-1] * np.diff(y[last])))
    damper = float(np.sum(10.0 * np.diff(y[last]) ** 2 * 750))
    assert work > 3 * damper > 0
