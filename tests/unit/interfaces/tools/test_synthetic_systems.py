"""The systems that the synthetic benchmark draws, with one sensor noise and two records each."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SEARCHES = Path(__file__).parents[4] / "benchmarks" / "searches"
NAMES = ("backlash", "heat_exchanger", "pendulum", "stick_slip", "neutralisation")


@pytest.fixture(scope="module")
def make() -> Any:
    """`make(name, seed)` draws a system."""
    sys.path.insert(0, str(SEARCHES))
    try:
        from systems import make_system  # type: ignore[import-not-found]
        from unfamiliar import UNFAMILIAR  # type: ignore[import-not-found]
    finally:
        sys.path.remove(str(SEARCHES))
    return lambda name, seed: make_system(UNFAMILIAR[name], seed)


@pytest.mark.parametrize("name", NAMES)
def test_an_unfamiliar_system_simulates_and_follows_from_its_seed_alone(
    name: str, make: Any
) -> None:
    system, again, other = make(name, 7), make(name, 7), make(name, 8)
    for record, same in ((system.train, again.train), (system.test, again.test)):
        assert np.isfinite(record.y).all()
        assert (record.truth.std(axis=0) > 0).all()
        np.testing.assert_array_equal(record.u, same.u)
        np.testing.assert_array_equal(record.y, same.y)
    noise = system.train.y - system.train.truth
    np.testing.assert_allclose(noise.std(axis=0), system.noise_std, rtol=0.2)
    assert not np.array_equal(system.train.truth, system.test.truth)
    assert not np.array_equal(system.train.truth, other.train.truth)
