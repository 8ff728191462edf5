"""Continuous equivalents of linear models with poles that no continuous system gives."""

from __future__ import annotations

import numpy as np
import pytest

from asia.errors import UserError
from asia.lowering.linear import LinearModel, continuous


def late(first: float) -> LinearModel:
    """A lag behind three samples, of whose response a small part comes one sample earlier."""
    a = np.array([[0.9, 1.0, first], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    b, c = np.array([[0.0], [0.0], [1.0]]), np.array([[1.0, 0.0, 0.0]])
    return LinearModel(a, b, c, np.zeros((1, 1)), 2.0, np.zeros(1), np.zeros(1))


def test_modes_at_zero_become_dead_time_where_the_response_hardly_changes() -> None:
    with pytest.raises(UserError, match="no continuous-time model"):
        continuous(late(1e-3))
    found, dead = continuous(late(1e-3), 0.05)
    assert dead == 2
    assert np.linalg.eigvals(found.a) == pytest.approx([np.log(0.9) / 2.0])
    assert found.gain[0, 0] == pytest.approx(10.0, rel=2e-3)


def test_a_response_that_changes_more_is_refused() -> None:
    with pytest.raises(UserError, match="no continuous-time model"):
        continuous(late(-0.8), 0.05)
