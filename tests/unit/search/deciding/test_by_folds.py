"""A new best shows its gain on the held-out samples of all folds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from asia.data import Array, Signal, Trajectory
from asia.judge.evaluation.evaluator import EvaluationData
from asia.ledger.artifacts import Store
from asia.ledger.run import open_run
from asia.presentation.experiments import decision_text
from asia.problem.folds import Fold, make_folds
from asia.problem.protocol import FoldRule, ProtocolRule
from asia.search.decision import fold_doubt
from asia.search.replay import replay_run
from tests.unit.search.toy import arx, search_toy, write_problem

RULE = ProtocolRule(folds=FoldRule(count=3), past_inputs=2, past_outputs=2)


def data() -> EvaluationData:
    rng = np.random.default_rng(0)
    record = Trajectory(rng.normal(size=600), rng.normal(size=600), 1.0, "r")
    context: Any = SimpleNamespace(inputs=(Signal("u"),), outputs=(Signal("y"),))
    return EvaluationData(make_folds([record], RULE), (record,), context, RULE)


def answers(folds: Sequence[Fold], errors: Sequence[float], seed: int) -> list[tuple[Array, ...]]:
    """Simulations with white errors of these sizes, one a fold."""
    rng = np.random.default_rng(seed)
    return [
        tuple(b.y + size * rng.normal(size=b.y.shape) for b in fold.held_out)
        for fold, size in zip(folds, errors, strict=True)
    ]


@pytest.mark.parametrize(
    ("errors", "status"),
    [
        ((0.5, 0.5, 0.5), None),
        ((1.0, 1.0, 0.99), "inconclusive"),
        ((0.3, 0.3, 1.6), "mixed"),
        ((0.3, 0.3, 1.02), None),
    ],
)
def test_a_gain_must_show_in_all_folds_together_and_no_fold_may_lose(
    tmp_path: Path, errors: Sequence[float], status: str | None
) -> None:
    known, store = data(), Store(tmp_path)
    before, after = answers(known.folds, (1.0, 1.0, 1.0), 1), answers(known.folds, errors, 2)
    best: Any = SimpleNamespace(
        folds=[SimpleNamespace(y_hat=store.put_arrays(one)) for one in before]
    )
    found: Any = SimpleNamespace(
        artifacts=store, folds=[SimpleNamespace(y_hat=store.put_arrays(one)) for one in after]
    )
    assert fold_doubt(cast(Any, SimpleNamespace(data=known)), found, best, store) == status


@pytest.mark.slow
def test_one_parameter_too_many_does_not_replace_the_right_model(tmp_path: Path) -> None:
    # The plant is of second order: a third one lowers V by chance, if at all.
    write_problem(tmp_path / "toy", retests=2)
    directory = search_toy(tmp_path, arx(2), arx(3), arx(4))
    run = open_run(directory)
    best = run.view.best
    assert run.view.started.by_folds
    assert best is not None
    assert best.number == 2
    for e in run.view.experiments[2:]:
        assert e.result is not None
        assert e.result.status in ("inconclusive", "discard")
        if e.value is not None and best.value is not None and e.value < best.value:
            assert "no more than chance" in decision_text(e, run.view)
    assert replay_run(directory, lambda item: None).agrees
