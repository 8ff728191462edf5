"""Scores of stored simulations: of the sealed test, and of a whole ledger once more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from asia.data.segment import Segment
from asia.data.trajectory import Array
from asia.errors import CandidateError, UserError
from asia.judge.scoring.euclidean_error import MeeTable, mee_table
from asia.judge.scoring.outcome import Outcome, Score, TestScore, score_outputs, score_test
from asia.ledger.artifacts import Store
from asia.ledger.events import Evaluated, Event, Landed, Started, TestedModel, Unsealed, Use
from asia.ledger.verification import check_lock
from asia.problem.folds import Fold, make_folds, whole
from asia.problem.load import load_lock
from asia.problem.metrics import MEE, find_metric
from asia.problem.problem import Problem
from asia.problem.seal import open_test
from asia.search.run import LOCK


def by_record(parts: Sequence[Array], blocks: Sequence[Segment]) -> tuple[Array, ...]:
    """The parts of each test record, one for each block, one below the other."""
    records = dict.fromkeys(block.record for block in blocks)
    pairs = list(zip(parts, blocks, strict=True))
    return tuple(np.concatenate([p for p, block in pairs if block.record == r]) for r in records)


def score_sealed(
    problem: Problem, measured: Sequence[Array], simulated: Sequence[Array]
) -> tuple[tuple[TestScore, ...], MeeTable | None]:
    """Score simulations of the sealed test by the test rule of the problem.

    Args:
        measured, simulated: one (samples, ny) array a record, windows one below the other

    Raises:
        CandidateError: for simulations of the wrong size or not finite
    """
    rule = problem.protocol.test
    scores = tuple(
        score_test(measured, simulated, name, rule.skip) for name in rule.metrics if name != MEE
    )
    if MEE not in rule.metrics:
        return scores, None
    names = [s.name for s in problem.outputs]
    window = (-1, problem.protocol.horizon or 1, len(names))
    y, y_hat = (list(np.concatenate(list(p)).reshape(window)) for p in (measured, simulated))
    return scores, mee_table(y, y_hat, names, rule.groups, rule.horizons)


@dataclass
class ScoreCheck:
    """Recompute the scores in a ledger from the stored simulations, event by event.

    `asia.ledger.verification.verify` calls it. It runs no candidate code. Fits from other seeds
    leave no simulations: their V is not recomputed.
    """

    directory: Path
    problem: Problem | None = None
    """The problem of the run; None to load it from the lock."""
    experiments: int = 0
    """Experiments whose V was recomputed."""
    tested: int = 0
    """Models whose test errors were recomputed."""
    not_recomputed: str = ""
    """Reason why no score was recomputed; "" where scores were."""
    test_not_compared: str = ""
    """Reason why the stored test outputs were not compared with the sealed records."""
    _folds: tuple[Fold, ...] = field(default=(), repr=False)

    def __call__(self, where: str, event: Event) -> None:
        """Check one event. Raises UserError when a score is not that of its simulations, or when
        the lock was changed."""
        if isinstance(event, Started):
            check_lock(self.directory, event)
            try:
                self.problem = self.problem or load_lock(self.directory / LOCK)
                self._folds = make_folds(self.problem.train, self.problem.protocol)
            except UserError as error:
                self.problem, self.not_recomputed = None, str(error)
        if self.problem is None:
            return
        match event:
            case Evaluated(outcome=Score() as score) | Landed(outcome=Score() as score):
                here = f"{where}: experiment {event.experiment}"
                again, metric = self._score(here, event), self.problem.protocol.metric
                _check_same(here, "", _named(score), _named(again), _slack(metric))
                self.experiments += isinstance(event, Evaluated)
            case Unsealed():
                self._check_test(where, event, self.problem)
            case _:
                pass

    @property
    def _store(self) -> Store:
        return Store(self.directory / "artifacts")

    def _score(self, where: str, event: Evaluated | Landed) -> Outcome:
        """The score of the stored simulations of an experiment."""
        assert self.problem is not None
        rule = self.problem.protocol
        simulated = [one.y_hat for one in event.folds if one.y_hat]
        if len(simulated) != len(self._folds):
            raise UserError(
                f"{where} has V, but simulations of {len(simulated)} folds: expected "
                f"{len(self._folds)}"
            )
        try:
            y_hat = [
                self._store.get_arrays(name, fold.shapes)
                for name, fold in zip(simulated, self._folds, strict=True)
            ]
            return score_outputs(self._folds, y_hat, rule.metric)
        except (CandidateError, UserError) as error:
            raise UserError(
                f"{where} has V, but its simulations cannot be scored: {error}"
            ) from None

    def _check_test(self, where: str, event: Unsealed, problem: Problem) -> None:
        """Compare the test outputs with the sealed records, and the errors of each model."""
        shapes = [(length, len(problem.outputs)) for length in event.lengths]
        measured = self._store.get_arrays(event.measured, shapes)
        try:
            blocks = whole(open_test(problem), problem.protocol)
        except UserError as error:
            self.test_not_compared = str(error)
        else:
            opened = by_record([block.y for block in blocks], blocks)
            if [a.tobytes() for a in opened] != [b.tobytes() for b in measured]:
                raise UserError(f"{where}: the stored test outputs are not those of the test")
        for use in get_args(Use):
            model = getattr(event, use)
            if not isinstance(model, TestedModel):
                continue
            try:
                again = score_sealed(problem, measured, self._store.get_arrays(model.y_hat, shapes))
            except (CandidateError, UserError) as error:
                raise UserError(
                    f"{where}: the test simulations of the {use} cannot be scored: {error}"
                ) from None
            recorded, now = (
                {
                    **{f"test {s.metric} of the {use}": asdict(s) for s in scores},
                    f"test {MEE} of the {use}": table and asdict(table),
                }
                for scores, table in ((model.scores, model.mee), again)
            )
            slack = max((_slack(s.metric) for s in model.scores), default=0.0)
            _check_same(where, "", recorded, now, slack)
            self.tested += 1


def _named(outcome: Outcome) -> dict[str, Any]:
    assert isinstance(outcome, Score)
    scores = tuple(asdict(one.score) for one in outcome.folds)
    return {"V": outcome.value, "V of fold": scores}


def _slack(metric: str) -> float:
    """Rounding error of a metric that is a difference from its best value, as a fit index."""
    return 1e-10 if find_metric(metric).direction == "higher" else 0.0


def _check_same(where: str, name: str, recorded: Any, again: Any, slack: float) -> None:
    """Compare two results number by number. Raises UserError that names the first difference."""
    if isinstance(recorded, dict) and isinstance(again, dict):
        one, now = cast("dict[str, Any]", recorded), cast("dict[str, Any]", again)
        if one.keys() != now.keys():
            raise UserError(f"{where}: the ledger has {', '.join(one)}, expected {', '.join(now)}")
        for key, value in one.items():
            inner = name if key == "value" else f"{name} {key}".strip()
            _check_same(where, inner, value, now[key], slack)
        return
    if isinstance(recorded, tuple) and isinstance(again, tuple) and len(recorded) == len(again):
        for k, pair in enumerate(zip(recorded, again, strict=True), 1):
            _check_same(where, f"{name} {k}", *pair, slack)
        return
    same = recorded == again
    if isinstance(recorded, float) and isinstance(again, float):
        # Another processor may round differently.
        slack = 1e-10 if "fit_index" in name or "r2" in name else slack
        same = math.isclose(recorded, again, rel_tol=1e-12, abs_tol=slack)
    if not same:
        raise UserError(
            f"{where}: {name} is {recorded!r} in the ledger, but {again!r} recomputed from its "
            "simulations"
        )
