"""Inputs that are carried at a pace, and the volume on their way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.data import Trajectory
from asia.data.relations import Transport, find_transport
from tests.unit.models.systems.transport import belt


@given(delay=st.integers(1, 12), pace=st.floats(0.1, 10.0), seed=st.integers(0, 1000))
def test_a_constant_pace_is_a_constant_delay(delay: int, pace: float, seed: int) -> None:
    u = np.column_stack([np.full(40, pace), np.random.default_rng(seed).normal(size=40)])
    found = Transport(0, delay * pace).carried(u)
    late = np.concatenate([np.repeat(u[:1], delay, axis=0), u])[:40]
    assert found == pytest.approx(np.column_stack([late, u[:, 0]]), abs=1e-6)


@settings(deadline=None)
@given(seed=st.integers(0, 1000), volume=st.floats(0.5, 8.0), cut=st.integers(1, 59))
def test_nothing_leaves_before_it_entered_and_what_entered_leaves(
    seed: int, volume: float, cut: int
) -> None:
    rng = np.random.default_rng(seed)
    u = np.column_stack([rng.uniform(0.2, 2.0, 60), rng.normal(size=60)])
    changed = u.copy()
    changed[cut:] = rng.uniform(0.2, 2.0, (60 - cut, 2))
    transport = Transport(0, volume)
    assert transport.carried(changed)[:cut] == pytest.approx(transport.carried(u)[:cut])
    constant = np.column_stack([u[:, 0], np.full(60, 3.0)])
    assert transport.carried(constant)[:, 1] == pytest.approx(3.0)


def test_a_pace_of_zero_stops_the_transport() -> None:
    u = np.column_stack([np.r_[np.ones(10), np.zeros(20)], np.arange(30.0)])
    found = Transport(0, 4.0).carried(u)[:, 1]
    assert found[9] == pytest.approx(5.0)
    assert np.ptp(found[11:]) < 0.1


def test_a_pace_slower_than_any_that_was_seen_counts_as_the_slowest() -> None:
    u = np.column_stack([np.r_[np.ones(10), np.full(20, 0.01)], np.arange(30.0)])
    slow = np.column_stack([np.maximum(u[:, 0], 0.5), u[:, 1]])
    transport = Transport(0, 4.0, slowest=0.5)
    assert transport.longest == 8
    assert transport.carried(u)[:, 1] == pytest.approx(transport.carried(slow)[:, 1])
    found = find_transport([belt(500, 0)], 0)
    assert found.slowest == pytest.approx(0.5 * belt(500, 0).u[:, 0].min())


def test_the_volume_is_found() -> None:
    assert find_transport([belt(500, 0)], 0).volume == pytest.approx(6.0, rel=0.1)


def test_a_pace_has_to_be_positive() -> None:
    record = belt(200, 0)
    with pytest.raises(ValueError, match="not positive"):
        find_transport([Trajectory(-record.u, record.y, 1.0)], 0)
