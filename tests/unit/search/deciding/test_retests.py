"""A new best must be better than luck of the seeds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import asia
from asia.errors import Reason
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator
from asia.judge.evaluation.references import LINEAR_REFERENCE
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.judge.scoring.repeated_fits import significance_threshold
from asia.ledger.events import Evaluated, Event, Fit, Proposed, ReferenceScored, Started
from asia.ledger.evidence import incumbent_threshold
from asia.ledger.view import Experiment, SearchView, replay
from asia.presentation.experiments import decision_text, method_note, threshold_text
from asia.search.decision import RETEST_LIMIT, Decision, decide
from asia.search.replay import replay_run
from tests.unit.search.toy import Scripted, arx, write_problem

DIGEST = "0" * 64
LUCKY = arx(2).replace(
    "    context.log(1, float(n))",
    """    # candidate {number}
    luck = np.random.default_rng([context.seed, {number}])
    weights = weights * (1.0 + 0.002 * luck.normal(size=weights.shape))""",
)


class Fits(Evaluator):
    """V of the fits of one candidate, one after the other."""

    may_fit_ahead = False

    def __init__(self, *outcomes: float | Failure) -> None:
        self.outcomes, self.starts = outcomes, list[int]()
        self.workers = cast(WorkerRunner, SimpleNamespace(is_sequential=True))
        self.data = cast(EvaluationData, SimpleNamespace(context=None, records=(), inner_folds=()))

    def evaluate(self, source: str, start: int = 0) -> Evaluation:
        """The next one."""
        self.starts.append(start)
        outcome = self.outcomes[len(self.starts) - 1]
        if isinstance(outcome, Failure):
            return Evaluation(outcome)
        fold = FoldRecord(outcome, (), (), (), (), y_hat=str(outcome))
        return Evaluation(Score(outcome, (fold,)))

    def objection(self, source: str, evaluation: object) -> None:
        """None."""


def a_search(retests: int, *incumbent: float) -> SearchView:
    """One experiment that was kept, with these values over its seeds."""
    start = Started(
        "run", "problem", "agent", 0, 9, None, ("y",), DIGEST, DIGEST, None, "process", (), {},
        retests=retests,
    )  # fmt: skip
    first, *others = incumbent
    again = tuple(Fit(7, "retest", value, same=value == first) for value in others)
    events: list[Event] = [
        start,
        Proposed(1, None, "baseline", "f", "t", "h", "e", "s", "d"),
        Evaluated(1, "keep", Score(first, ()), None, 1.0, retests=again),
    ]
    return replay(events)


def judged(view: SearchView, *outcomes: float | Failure) -> tuple[Decision, int]:
    """The decision, and how many fits it took."""
    evaluator = Fits(*outcomes)
    return decide(evaluator, "", view), len(evaluator.starts)


NOISY = 1.0, 1.1, 0.9


@pytest.mark.parametrize(
    ("outcomes", "status", "fits"),
    [
        ((1.01,), "discard", 1),
        ((0.95,), "inconclusive", 1),
        ((0.80, 0.95, 0.93), "inconclusive", 3),
        ((0.80, 1.25), "inconclusive", 2),
        ((0.60, 0.80, 0.65), "keep", 3),
        ((0.200, 0.201), "keep", 2),
        ((0.20, 0.25, 0.22), "keep", 3),
        ((0.70, 0.70), "keep", 2),
        ((0.50, Failure(Reason.CRASH)), "inconclusive", 2),
    ],
)
def test_a_candidate_must_stand_out_over_its_seeds(
    outcomes: tuple[float | Failure, ...], status: str, fits: int
) -> None:
    found, taken = judged(a_search(2, *NOISY), *outcomes)
    assert (found.status, taken) == (status, fits)
    assert isinstance(found.evaluation.outcome, Score)
    assert found.evaluation.outcome.value == outcomes[0]
    assert len(found.retests) == fits - 1


def test_lost_fits_of_the_incumbent_do_not_keep_a_better_candidate_out() -> None:
    view = a_search(2, 0.036, 0.016, 0.075)
    found, fits = judged(view, 0.0145, 0.0146, 0.0144)
    assert found.threshold is not None
    assert (
        found.threshold > np.mean([0.036, 0.016, 0.075]) - 0.0145
    )  # By the means it is not lower.
    assert (found.status, fits) == ("keep", 3)
    after = with_another(view, 2, found)
    assert decision_text(after.experiments[1], after) == (
        "V 59.7 % below #01, each seed below every one of #01"
    )
    assert judged(view, 0.0145, 0.0146, 0.017)[0].status == "inconclusive"
    assert "or V of 3 seeds is below 0.0160, the lowest of #01" in threshold_text(view)


def test_where_no_fit_depends_on_the_seed_any_lower_value_is_kept_after_one_more_fit() -> None:
    found, fits = judged(a_search(2, 1.0, 1.0), 0.999, 0.999)
    assert (found.status, found.threshold, fits) == ("keep", 0.0, 2)
    assert found.retests[0].same


def test_a_ledger_without_retests_is_decided_by_the_first_fit() -> None:
    found, fits = judged(a_search(0, 1.0), 0.999)
    assert (found.status, found.threshold, fits) == ("keep", None, 1)


def test_the_first_candidate_with_a_score_is_kept_and_measures_the_threshold() -> None:
    view = replace(a_search(2, 1.0), experiments=())
    found, fits = judged(view, 1.0, 1.1, 0.9)
    assert (found.status, found.threshold, fits) == ("keep", None, 3)
    assert judged(view, 1.0, Failure(Reason.CRASH))[0].status == "keep"


def test_what_is_far_worse_than_the_linear_reference_is_not_fitted_from_other_seeds() -> None:
    known = a_search(2, 1.0)
    view = replace(
        known,
        started=replace(known.started, retest_limit=RETEST_LIMIT),
        references=(ReferenceScored(LINEAR_REFERENCE, Score(0.4, ())),),
    )
    first = replace(view, experiments=())
    assert judged(first, 0.7)[1] == 1
    assert judged(first, 0.5, 0.51, 0.52)[1] == 3
    found, fits = judged(view, 0.7)
    assert (found.status, found.retests, found.lowest, fits) == ("keep", (), True, 1)
    assert decision_text(with_another(view, 2, found).experiments[1], view) == (
        "V 30.0 % below #01"
    )
    assert judged(view, 0.4, 0.41, 0.42)[1] == 2
    assert judged(replace(view, references=()), 0.7, 0.71, 0.72)[1] == 2
    assert judged(replace(view, started=known.started), 0.7, 0.71, 0.72)[1] == 2


def test_the_seeds_are_not_those_of_a_confirmation() -> None:
    evaluator = Fits(0.6, 0.8, 0.65)
    decide(evaluator, "", a_search(2, *NOISY))
    assert evaluator.starts[0] == 0
    assert min(evaluator.starts[1:]) > 1000
    assert len(set(evaluator.starts)) == 3


def test_the_threshold_is_students_interval() -> None:
    from scipy.stats import ttest_ind

    one, other = [1.0, 1.1, 0.9], [0.5, 0.56, 0.53]
    interval = ttest_ind(one, other).confidence_interval(0.9)
    assert significance_threshold(one, other) == pytest.approx((interval.high - interval.low) / 2)
    assert significance_threshold([1.0], [2.0]) == 0.0


def test_the_threshold_is_told_once_it_is_known() -> None:
    assert incumbent_threshold(a_search(2, *NOISY)) == pytest.approx(
        significance_threshold(NOISY, NOISY)
    )
    assert "below 1.0000, the mean of #01 over 3 seeds" in threshold_text(a_search(2, *NOISY))
    same = threshold_text(a_search(2, 1.0, 1.0))
    assert "the fits of #01 do not depend on the seed" in same
    assert "below 1.0000, the V of #01, by more than its own V varies" in same
    assert incumbent_threshold(a_search(0, 1.0)) is None


@pytest.mark.long
def test_a_search_among_equals_keeps_the_baseline_and_replays(tmp_path: Path) -> None:
    """Candidates that differ in luck alone, in a real search: a lower V is not kept."""
    problem = write_problem(tmp_path / "toy", retests=2)
    (problem / "baseline.py").write_text(LUCKY.replace("{number}", "3"))
    agent = Scripted(tuple(LUCKY.replace("{number}", str(n)) for n in (0, 1, 2)))
    run = asia.run(problem, agent=agent, runs=tmp_path / "runs", experiments=4)
    results = [e.result for e in run.view.finished if e.result]
    assert run.view.started.retests == 2
    assert [r.status == "keep" for r in results] == [True, False, False, False]
    assert len(results[0].retests) == 2
    assert not results[0].retests[0].same
    assert all(item.agrees for item in replay_run(run.directory, lambda item: None).items)


@pytest.mark.slow
def test_a_deterministic_search_repeats_each_new_best_once(tmp_path: Path) -> None:
    problem = write_problem(tmp_path / "toy", retests=2)
    run = asia.run(problem, agent=Scripted((arx(2),)), runs=tmp_path / "runs", experiments=2)
    again = [e.result.retests for e in run.view.finished if e.result]
    # The first one is far worse than the linear reference.
    assert [[r.same for r in retests] for retests in again] == [[], [True]]
    assert run.view.best is not None
    assert run.view.best.number == 2


@pytest.mark.parametrize(
    ("outcomes", "status", "lowest"),
    [
        ((1.01,), "discard", False),
        ((0.95,), "inconclusive", True),
        ((0.80, 1.25), "inconclusive", True),
        ((0.60, 0.80, 0.65), "keep", True),
    ],
)
def test_the_fit_with_the_lowest_v_is_the_best_whatever_is_said_of_its_method(
    outcomes: tuple[float, ...], status: str, lowest: bool
) -> None:
    view = a_search(2, *NOISY)
    found, _ = judged(view, *outcomes)
    assert (found.status, found.lowest) == (status, lowest)
    after = with_another(view, 2, found)
    assert after.best is not None
    assert after.best.number == (2 if lowest else 1)
    assert after.incumbent is not None
    assert after.incumbent.number == (2 if status == "keep" else 1)
    assert bool(method_note(after)) == (after.best.number != after.incumbent.number)
    if after.best.number != after.incumbent.number:
        higher = np.mean(after.best.seed_values) > np.mean(after.incumbent.seed_values)
        assert ("has the lower mean" if higher else "statistically equal") in method_note(after)


def test_a_retest_that_failed_is_not_called_equal() -> None:
    view = a_search(2, *NOISY)
    found, _ = judged(view, 0.50, 1.60)
    failed = replace(found, retests=(Fit(7, "retest", failed="crash"),))
    note = method_note(with_another(view, 2, failed))
    assert note.startswith("a fit of #02 from another seed failed, so #01 remains the incumbent; ")


def test_a_method_that_is_kept_does_not_replace_a_better_fit() -> None:
    view = a_search(2, *NOISY)
    view = with_another(view, 2, judged(view, 0.50, 1.60)[0])
    found, _ = judged(view, 0.60, 0.60)
    assert (found.status, found.lowest) == ("keep", False)
    after = with_another(view, 3, found)
    assert [e.number for e in after.bests] == [1, 2]
    assert after.incumbent is not None
    assert after.incumbent.number == 3


def test_a_fit_that_is_handed_over_is_checked_like_one_that_is_kept() -> None:
    class Objecting(Fits):
        def objection(self, source: str, folds: object) -> Failure:
            return Failure(Reason.RESTART)

    found = decide(Objecting(0.95), "", a_search(2, *NOISY))
    assert (found.status, found.lowest) == (Reason.RESTART.status, False)
    assert decide(Objecting(1.01), "", a_search(2, *NOISY)).status == "discard"


def test_where_one_fit_decides_the_best_is_the_incumbent() -> None:
    view = a_search(0, 1.0)
    found, _ = judged(view, 0.999)
    assert not found.lowest
    after = with_another(view, 2, found)
    assert after.best == after.incumbent == after.experiment(2)


def with_another(view: SearchView, number: int, found: Decision) -> SearchView:
    """The search after one more experiment."""
    proposed = Proposed(number, None, "refine", "f", "t", "h", "e", "s", "d")
    result = Evaluated(
        number, found.status, found.evaluation.outcome, None, 1.0,
        retests=found.retests, threshold=found.threshold, lowest=found.lowest,
    )  # fmt: skip
    return replace(view, experiments=(*view.experiments, Experiment(proposed, result)))
