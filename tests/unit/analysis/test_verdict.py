"""The verdict on the model to use, and its table of levels."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.analysis.verdict import LEVELS, usability
from asia.judge.scoring.outcome import FoldRecord, Score, explained_variance
from asia.ledger.artifacts import Store
from asia.ledger.events import Event, ReferenceScored
from asia.ledger.evidence import fold_estimates, with_fold_values
from asia.ledger.view import SearchView, replay
from tests.unit.ledger.conftest import evaluated, proposed, started

ROOT = Path(__file__).parents[3]


def of_folds(tmp_path: Path, folds: list[tuple[float, float]], linear: float = 9.0) -> SearchView:
    """A search whose best candidate has these RMSEs and R2."""
    each = tuple(FoldRecord(e, (e,), (e,), (50.0,), (r2,)) for e, r2 in folds)
    other = tuple(FoldRecord(linear, (linear,), (linear,), (50.0,), (0.5,)) for _ in folds)
    score = Score(float(np.mean([e for e, _ in folds])), each)
    lines: list[Event] = [
        replace(started(), isolation="landlock"),
        ReferenceScored("linear model", Score(linear, other)),
        proposed(Store(tmp_path), 1),
        evaluated(1, "keep", score),
    ]
    return replay(lines)


@pytest.mark.parametrize(
    ("folds", "kind", "reason"),
    [
        ([(0.2, 0.96), (0.3, 0.91)], "not validated", "The search is not finished"),
        ([(0.2, 0.96), (0.9, 0.2)], "doubtful", "It explains 20% of the variance of y in fold 2"),
        ([(0.9, 0.2), (1.1, -0.1)], "not usable", "worse than the mean of the output in fold 2"),
        # The output is at rest in fold 2: its mean there is a perfect model of it.
        ([(0.2, 0.96), (0.2, -0.5)], "doubtful", "Fold 2 does not test the model"),
    ],
)
def test_every_fold_has_to_be_explained(
    tmp_path: Path, folds: list[tuple[float, float]], kind: str, reason: str
) -> None:
    found = usability(of_folds(tmp_path, folds))
    assert found is not None
    assert found.kind == kind
    assert reason in found.reasons[0]


def test_a_linear_model_that_is_better_in_every_fold_is_a_doubt(tmp_path: Path) -> None:
    found = usability(of_folds(tmp_path, [(0.2, 0.96), (0.3, 0.91)], linear=0.1))
    assert found is not None
    assert "A linear model is better in every fold" in found.reasons[0]


@pytest.mark.parametrize("factor", [1e-12, 1e12])
def test_the_explained_variance_does_not_depend_on_units(factor: float) -> None:
    folds = [(0.2, 0.96), (0.2, -0.5), (0.5, 0.6)]
    first, second = (
        explained_variance(
            Score(1.0, tuple(FoldRecord(e, (k * e,), (k * e,), (50.0,), (r2,)) for e, r2 in folds))
        )
        for k in (1.0, factor)
    )
    np.testing.assert_allclose(first, second)


def test_the_documentation_has_the_table_of_levels() -> None:
    text = (ROOT / "docs" / "design" / "model-to-use.md").read_text("utf-8")
    for one in LEVELS:
        assert f"| {one.statistic} | {one.level:g} | {one.source} |" in text


def test_parameters_without_a_refit_are_means_over_the_fold_models() -> None:
    found = fold_estimates([{"k": 1.0, "tau": 4.0}, {"k": 1.2, "tau": 4.0, "only here": 1.0}])
    assert found is not None
    assert [one.name for one in found.parameters] == ["k", "tau"]
    k = found.parameters[0]
    assert k.value == pytest.approx(1.1)
    assert k.standard_error == pytest.approx(0.1)
    assert "mean over the fold models" in found.source
    # Two folds would give tau an interval of no width.
    assert all(one.interval is None for one in with_fold_values(found, [{"k": 1.0, "tau": 4.0}]))
    assert fold_estimates([{"k": 1.0}]) is None
    of_one = fold_estimates([{"k": 1.0}, {"k": 1.2}], fold=2)
    assert of_one is not None
    assert of_one.parameters[0].value == 1.2
    assert "of the model of fold 2" in of_one.source


@pytest.mark.parametrize(
    ("quality", "expected"),
    [
        ("good", {"usable"}),
        ("mediocre", {"usable", "doubtful", "not usable"}),
        ("useless", {"doubtful", "not usable"}),
    ],
)
def test_models_of_known_quality(
    monkeypatch: pytest.MonkeyPatch, quality: str, expected: set[str]
) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "validation")
    monkeypatch.delitem(sys.modules, "verdicts", raising=False)
    import verdicts  # type: ignore[import-not-found]

    assert {verdicts.judge(quality, number).kind for number in range(4)} <= expected
