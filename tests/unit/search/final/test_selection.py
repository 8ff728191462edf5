"""Laws of the weights of a stack, and the rule for the model to use."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from asia.data import Array
from asia.ledger.events import Fit, RefitCheck, Stack, StackMember
from asia.search.final import MOST_MEMBERS, NEAR, FinalEvidence, choose_model, stack_weights

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


def evidence(
    refit: float, ensemble: float, disagreement: float, stack: float | None = None, folds: int = 3
) -> FinalEvidence:
    start = Fit(0, "refit", refit, disagreement=disagreement)
    check = RefitCheck((ensemble,) * folds, ensemble, disagreement, (start,), 1)
    members = StackMember(2, 0.6), StackMember(3, 0.4)
    made = None if stack is None else Stack(members, stack, (stack,) * folds)
    return FinalEvidence(value=1.0, check=check, detail="", stack=made)


@pytest.mark.parametrize(
    ("found", "model"),
    [
        # The last third of the data made the refit better.
        (evidence(refit=0.6, ensemble=1.0, disagreement=0.5, stack=1.1), "refit"),
        # A little better is not enough: the fold models were chosen by V, the refit was not.
        (evidence(refit=0.9, ensemble=1.0, disagreement=0.5, stack=1.1), "stack"),
        # It did not: the error is that of the structure, which means reduce.
        (evidence(refit=1.0, ensemble=1.0, disagreement=0.5, stack=1.1), "stack"),
        (evidence(refit=1.0, ensemble=1.0, disagreement=0.5, stack=1.3), "ensemble"),
        (evidence(refit=1.0, ensemble=1.0, disagreement=0.5), "ensemble"),
        # Nothing to gain from a mean.
        (evidence(refit=1.0, ensemble=1.0, disagreement=0.1, stack=1.0), "refit"),
        # With two folds a fold model has seen half of the data.
        (evidence(refit=1.0, ensemble=1.0, disagreement=0.5, stack=1.1, folds=2), "refit"),
        (evidence(refit=1.2, ensemble=1.0, disagreement=0.5, stack=1.1), "stack"),
        (evidence(refit=1.2, ensemble=1.0, disagreement=0.5, stack=1.1, folds=2), "ensemble"),
        (evidence(refit=0.6, ensemble=1.0, disagreement=0.5, stack=0.7), "stack"),
    ],
)
def test_the_model_to_use_follows_what_data_and_means_are_worth(
    found: FinalEvidence, model: str
) -> None:
    chosen = choose_model(found)
    assert chosen.model == model
    assert chosen.reason.endswith(".")
