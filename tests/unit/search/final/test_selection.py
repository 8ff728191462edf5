"""Laws of the weights of a stack, and the rule for the model to use."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from asia.data import Array
from asia.ledger.events import Use
from asia.search.final import MOST_MEMBERS, NEAR, choose_model, stack_weights

values = arrays(
    float, st.tuples(st.integers(1, 4), st.integers(1, 30)), elements=st.floats(0, 1e300)
)


@given(values)
def test_weights_are_shares_of_the_few_nearest_to_the_best(values: Array) -> None:
    weights, mean = stack_weights(values), values.mean(axis=0)
    assert weights.sum() == pytest.approx(1.0)
    assert np.count_nonzero(weights) <= MOST_MEMBERS
    assert weights[mean.argmin()] == weights.max() > 0
    assert (weights[mean > 1.001 * NEAR * max(mean.min(), 1e-300)] == 0).all()
    # None of lower V has less.
    assert (np.diff(weights[np.argsort(mean, kind="stable")]) <= 1e-12).all()


def test_weights_are_inverse_to_the_fourth_power_of_v() -> None:
    found = stack_weights(np.array([[1.0, 2.0, 9.0], [1.0, 0.5, 9.0]]))
    assert found == pytest.approx(np.array([1.25**4, 1.0, 0.0]) / (1.25**4 + 1.0))
    assert stack_weights(np.array([[1e99, 0.1, 0.5, 1e300]])).tolist() == [0, 1, 0, 0]
    assert stack_weights(np.zeros((2, 2))).tolist() == [0.5, 0.5]


# The model to use.


ONE = np.array([1.0, 1.2, 0.8, 1.0, 1.1, 0.9])
"""Errors of the best candidate on parts of the held-out records."""
FAR = np.array([0.0, 0.0, 9.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("single", "stack", "use"),
    [
        (ONE, None, "refit"),
        (ONE, ONE + 0.2, "refit"),
        # Better by less than its standard error.
        (ONE, ONE - np.array([0.3, -0.3, 0.2, -0.1, 0.1, 0.0]), "refit"),
        (ONE, ONE - 0.2, "stack"),
        # The best candidate diverges in a single part, or the stack does.
        (ONE + FAR, ONE, "stack"),
        (ONE, ONE + FAR, "refit"),
    ],
)
def test_a_stack_is_used_where_it_is_better_than_one_standard_error(
    single: Array, stack: Array | None, use: Use
) -> None:
    assert choose_model(single, stack).model == use
    without = choose_model(single, stack, "the refit diverged")
    assert without.model == ("ensemble" if use == "refit" else use)
    assert use == "stack" or without.reason == "The refit diverged."
