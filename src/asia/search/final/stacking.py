"""A stack of the candidates of a search, from the simulations that its ledger keeps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.evaluation import FAR_BELOW, Evaluator, FoldResult, consistency
from asia.ledger import Experiment, SearchView, Stack, StackMember, Store
from asia.protocol import Fold, find_metric
from asia.search.final.selection import (
    HeldOutPart,
    Shortfall,
    candidates,
    nested_weights,
    select_weights,
)

# Weights need few samples; V of the stack is computed on all of them.
_MOST_SAMPLES = 2000
_ROUNDS = 3


def make_stack(evaluator: Evaluator, view: SearchView, store: Store, metric: str) -> Stack | None:
    """The stack of all scored candidates; None where it would be one candidate alone. A member that
    was never checked, because it was no new best, is asked what new bests are asked, and left out
    where it objects."""
    scored = [e for e in view.finished if e.score is not None and _is_its_own(e)]
    refused: set[int] = set()
    for _ in range(_ROUNDS):
        found = _Stacking(evaluator.folds, store, metric, _eligible(scored, refused)).stack()
        if found is None or view.best is None or view.best.score is None:
            return None
        if view.started.ladder is not None or found.value >= view.best.score.value:
            return found  # with the Ladder all were checked; otherwise this stack is not named
        members = [view.experiment(m.experiment) for m in found.members]
        unchecked = [e for e in members if not (e.kept or e.lowest)]
        bad = {e.number for e in unchecked if not _answers_like_a_model(evaluator, e, store)}
        if not bad:
            return found
        refused |= bad
    return None


def _is_its_own(experiment: Experiment) -> bool:
    """Neither the copy of another one, nor much better where it was not fitted."""
    result, score = experiment.result, experiment.score
    if result is None or score is None or result.duplicate_of is not None:
        return False
    errors = [fold.diagnostics.train_error for fold in result.folds]
    return experiment.kept or experiment.lowest or consistency(score.value, errors) >= FAR_BELOW


def _eligible(scored: Sequence[Experiment], refused: Collection[int]) -> list[Experiment]:
    """Those that can be members by the folds of any of the selections."""
    left = [e for e in scored if e.number not in refused]
    if not left:
        return []
    values = np.array([[fold.value for fold in e.score.folds] for e in left if e.score]).T
    others = [np.delete(values, k, axis=0).tolist() for k in range(len(values))]
    places = {place for part in (values.tolist(), *others) for place in candidates(part)}
    return [left[place] for place in sorted(places)]


def _answers_like_a_model(evaluator: Evaluator, experiment: Experiment, store: Store) -> bool:
    result, score = experiment.result, experiment.score
    assert result is not None
    assert score is not None
    folds = [
        FoldResult(one, store.get(kept.model), _answers(store, kept.y_hat, fold),
                   np.zeros((0, 2)), kept.diagnostics, kept.fit_seconds)
        for one, kept, fold in zip(score.folds, result.folds, evaluator.folds, strict=True)
    ]  # fmt: skip
    return evaluator.objection(store.text(experiment.proposed.source), folds) is None


def _answers(store: Store, digest: str, fold: Fold) -> tuple[Array, ...]:
    return store.get_arrays(digest, [block.y.shape for block in fold.validation])


@dataclass(frozen=True)
class _Stacking:
    folds: Sequence[Fold]
    store: Store
    metric: str
    experiments: Sequence[Experiment]

    def stack(self) -> Stack | None:
        """Weights from all folds, V from weights that the judged fold had no part in."""
        if len(self.experiments) < 2:
            return None
        parts = [self._part(fold) for fold in self.folds]
        weights = select_weights(parts, self._shortfall)
        if np.count_nonzero(weights) < 2:
            return None
        nested = nested_weights(parts, self._shortfall)
        values = [self._judged(fold, w) for fold, w in zip(self.folds, nested, strict=True)]
        order = [k for k in np.argsort(-weights, kind="stable").tolist() if weights[k] > 0]
        members = tuple(StackMember(self.experiments[k].number, float(weights[k])) for k in order)
        return Stack(members, float(np.mean(values)), tuple(values))

    @property
    def _shortfall(self) -> Shortfall:
        return find_metric(self.metric).shortfall

    def _part(self, fold: Fold) -> HeldOutPart:
        y = np.concatenate([block.y for block in fold.validation])
        thin = slice(None, None, -(-len(y) // _MOST_SAMPLES))
        y_hat = np.stack([self._simulated(e, fold)[thin] for e in self.experiments])
        values = tuple(e.score.folds[fold.index].value for e in self.experiments if e.score)
        return HeldOutPart(y[thin], y_hat, fold.scale, values)

    def _simulated(self, experiment: Experiment, fold: Fold) -> Array:
        assert experiment.result is not None
        return np.concatenate(_answers(self.store, experiment.result.folds[fold.index].y_hat, fold))

    def _judged(self, fold: Fold, weights: Array) -> float:
        """The error of the weighted mean on all samples that the fold holds out."""
        y = np.concatenate([block.y for block in fold.validation])
        y_hat = np.zeros_like(y)
        for place in np.flatnonzero(weights).tolist():
            y_hat += weights[place] * self._simulated(self.experiments[place], fold)
        return self._shortfall(y, y_hat, fold.scale)
