"""Trivial references every search reports, so that a V has something to stand beside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asia.evaluation._evaluator import Evaluator, score_outputs
from asia.problem import Array
from asia.protocol import Block, Fold
from asia.scoring import Outcome

LINEAR = '''"""Best linear model: state-space, order chosen inside the training data."""

from asia.models import linear
from asia.models.methods import LevenbergMarquardt


def build_model(context):
    return linear.build(linear.Config(), context)


def train(model, trajectories, context):
    return linear.train(model, trajectories, context, LevenbergMarquardt(iterations=30))


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
'''


@dataclass(frozen=True)
class Rung:
    """A named reference and its outcome."""

    name: str
    outcome: Outcome


def score_rungs(
    evaluator: Evaluator, metric: str, truth: Sequence[Array] | None
) -> tuple[Rung, ...]:
    """Training mean, last output held, best linear model; for simulated problems also the
    noise-free truth, whose V is the noise floor. truth: one (T, ny) array a training record."""
    folds = evaluator.folds

    def scored(name: str, simulate: Callable[[Fold, Block], Array]) -> Rung:
        outputs = [[simulate(fold, block) for block in fold.validation] for fold in folds]
        return Rung(name, score_outputs(folds, outputs, metric))

    rungs = [
        scored("training mean", lambda fold, block: _constant(_mean(fold), block)),
        scored("last output held", lambda _, block: _constant(block.case.past_y[-1:], block)),
        Rung("linear model", evaluator.evaluate(LINEAR).outcome),
    ]
    if truth is not None:
        known = truth
        rungs.append(
            scored(
                "simulated truth", lambda _, block: known[block.record][block.start : block.stop]
            )
        )
    return tuple(rungs)


def _mean(fold: Fold) -> Array:
    return np.concatenate([t.y for t in fold.train]).mean(axis=0, keepdims=True)


def _constant(row: Array, block: Block) -> Array:
    """`row` (1, ny) held; the training mean where the protocol gives no past output."""
    return np.repeat(row, len(block.y), axis=0)
