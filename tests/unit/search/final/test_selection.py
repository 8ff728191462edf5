"""Laws of the weights of a stack, and the rule for the model to use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.data import Array
from asia.ledger.events import RefitCheck, RefitStart, Stack, StackMember
from asia.search.final import (
    MOST_CANDIDATES,
    MOST_MEMBERS,
    FinalEvidence,
    HeldOutPart,
    candidates,
    choose_model,
    nested_weights,
    select_weights,
)


def rmse(y: Array, y_hat: Array, scale: Array) -> float:
    return float(np.mean(np.sqrt(np.mean((y - y_hat) ** 2, axis=0)) / scale))


def part(random: np.random.Generator, count: int, samples: int = 20, ny: int = 2) -> HeldOutPart:
    """Truth with errors that differ in size, and that candidates share in part."""
    y = random.normal(size=(samples, ny))
    shared = random.normal(size=(samples, ny))
    sizes = random.uniform(0.05, 0.5, size=count)
    y_hat = np.stack([y + s * (random.normal(size=y.shape) + shared) for s in sizes])
    scale = y.std(axis=0)
    return HeldOutPart(y, y_hat, scale, tuple(rmse(y, one, scale) for one in y_hat))


numbers = st.integers(0, 2**32 - 1)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=numbers, count=st.integers(1, 30), folds=st.integers(1, 3))
def test_weights_are_shares_of_few_members(seed: int, count: int, folds: int) -> None:
    random = np.random.default_rng(seed)
    parts = [part(random, count) for _ in range(folds)]
    weights = select_weights(parts, rmse)
    assert weights.shape == (count,)
    assert (weights >= 0).all()
    assert weights.sum() == pytest.approx(1.0)
    assert np.count_nonzero(weights) <= MOST_MEMBERS
    assert (weights == select_weights(parts, rmse)).all()


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=numbers, count=st.integers(2, 12), folds=st.integers(2, 4), judged=st.integers(0, 3))
def test_the_fold_that_is_judged_has_no_part_in_its_weights(
    seed: int, count: int, folds: int, judged: int
) -> None:
    random = np.random.default_rng(seed)
    parts = [part(random, count) for _ in range(folds)]
    place = judged % folds
    changed = list(parts)
    changed[place] = part(random, count)
    before, after = nested_weights(parts, rmse), nested_weights(changed, rmse)
    assert (before[place] == after[place]).all()
    left_out = [one for k, one in enumerate(parts) if k != place]
    assert (before[place] == select_weights(left_out, rmse)).all()


@settings(max_examples=25, deadline=None)
@given(seed=numbers, count=st.integers(1, 5))
def test_where_the_weights_come_from_few_candidates_do_not_lose_to_the_best_of_them(
    seed: int, count: int
) -> None:
    parts = [part(np.random.default_rng(seed), count)]
    weights = select_weights(parts, rmse)
    mean = np.tensordot(weights, parts[0].y_hat, axes=1)
    assert rmse(parts[0].y, mean, parts[0].scale) <= min(parts[0].values) + 1e-12


def test_opposite_errors_share_what_is_left_of_the_weight_of_the_best() -> None:
    y = np.sin(np.arange(50.0))[:, None]
    error = np.cos(3 * np.arange(50.0))[:, None]
    y_hat = np.stack([y + 0.1 * error, y - 0.101 * error, y + 0.15])
    scale = y.std(axis=0)
    parts = [HeldOutPart(y, y_hat, scale, tuple(rmse(y, one, scale) for one in y_hat))]
    assert select_weights(parts, rmse) == pytest.approx([0.75, 0.25, 0.0])


def test_the_best_alone_where_the_others_are_far_worse() -> None:
    parts = [part(np.random.default_rng(0), 4)]
    spoilt = replace(parts[0], values=(1e99, 0.1, 0.5, 1e300))
    assert candidates([spoilt.values]) == [1]
    assert select_weights([spoilt], rmse).tolist() == [0, 1, 0, 0]


def test_no_more_than_so_many_candidates_are_tried() -> None:
    values = np.linspace(1.0, 1.1, 2 * MOST_CANDIDATES)
    assert candidates([values.tolist()]) == list(range(MOST_CANDIDATES))


# The model to use.


def evidence(
    refit: float, ensemble: float, disagreement: float, stack: float | None = None, folds: int = 3
) -> FinalEvidence:
    start = RefitStart(refit, disagreement, "")
    check = RefitCheck((ensemble,) * folds, ensemble, disagreement, (start,), 1)
    members = StackMember(2, 0.6), StackMember(3, 0.4)
    made = None if stack is None else Stack(members, stack, (stack,) * folds)
    return FinalEvidence(value=1.0, check=check, detail="", stack=made)


@pytest.mark.parametrize(
    ("found", "model"),
    [
        # The last third of the data made the refit better.
        (evidence(refit=0.6, ensemble=1.0, disagreement=0.5, stack=1.1), "refit"),
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
