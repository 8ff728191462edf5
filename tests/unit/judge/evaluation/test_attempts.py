"""Fits that end in a poor minimum in one fold are repeated from other seeds."""

from __future__ import annotations

from asia.judge.evaluation.results import FoldResult, derive_seed
from tests.unit.judge.evaluation.test_oracle import evaluator, value
from tests.unit.search.toy import arx

LUCK = """


class Poor(Model):
    def simulate(self, past_u, past_y, u):
        return super().simulate(past_u, past_y, u) + 3.0


fit_well = fit


def fit(trajectories, context):
    model = fit_well(trajectories, context)
    if not ({condition}):
        return model
    poor = Poor(model.weights)
    poor.seed = context.seed
    return poor
"""


def poor_for(seeds: set[int] | None, fold: int) -> str:
    """Source whose fits of a fold are poor from these seeds; None: from any."""
    first = evaluator("inner").data.folds[fold].train[0].y[0, 0]
    condition = f"trajectories[0].y[0, 0] == {float(first)!r}"
    if seeds is not None:
        condition += f" and context.seed in {sorted(seeds)}"
    return arx(2) + LUCK.replace("{condition}", condition)


def seed_of(fold: int, start: int) -> int:
    return derive_seed(evaluator("inner").data.context.seed, fold, start)


def test_a_poor_fold_is_fitted_from_another_seed() -> None:
    seeds = {seed_of(1, start) for start in (0, 1000)}
    found = evaluator("inner").evaluate(poor_for(seeds, 1))
    assert [fold.attempt for fold in found.folds] == [0, 2]
    assert value(found) == value(evaluator("inner").evaluate(arx(2)))


def test_a_fold_whose_data_are_hard_keeps_its_first_fit() -> None:
    found = evaluator("inner").evaluate(poor_for(None, 1))
    assert [fold.attempt for fold in found.folds] == [0, 0]
    assert value(found) > 2 * value(evaluator("inner").evaluate(arx(2)))


def test_the_second_fit_of_the_winner_has_the_seed_that_was_kept() -> None:
    judge = evaluator("inner")
    source = poor_for({seed_of(k, 0) for k in range(2)}, 0)
    found = judge.evaluate(source)
    attempts = [fold.attempt for fold in found.folds]
    assert attempts == [1, 0]
    refit = judge.refit(source, attempts)
    assert isinstance(refit.again, FoldResult)
    assert refit.again.model == found.folds[refit.fold - 1].model


def test_fits_that_stop_by_the_held_out_score_are_not_repeated() -> None:
    found = evaluator("validation").evaluate(poor_for({seed_of(1, 0)}, 1))
    assert [fold.attempt for fold in found.folds] == [0, 0]
