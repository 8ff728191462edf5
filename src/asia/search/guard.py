"""The gate: a new best is kept only if records that nobody in the search could read confirm it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from asia.candidate import library_only
from asia.data.segment import Segment
from asia.data.trajectory import Array
from asia.errors import CandidateError
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.evaluation.references import MEAN_REFERENCE
from asia.judge.scoring.confirmation import (
    ComparedParts,
    Confirmation,
    paired_gain,
    share_gained,
)
from asia.judge.scoring.outcome import Failure, Outcome, Score, combine, mean_simulation, score_fold
from asia.judge.scoring.repeated_fits import Interval
from asia.ledger.artifacts import Store
from asia.ledger.events import GuardLooked, GuardScore, Stack, StackMember
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import whole
from asia.problem.problem import Problem
from asia.problem.seal import open_guard

NEW_BESTS = 3
_ROUNDING = 1e-6
"""Share of the V of the first best below which a V is exact."""
Simulation = tuple[Array, ...]


def simulated(
    evaluator: Evaluator, source: str, models: Sequence[bytes], blocks: Sequence[Segment]
) -> Simulation:
    """Return the mean simulation (H, ny) of each block by fold models. Raises CandidateError."""
    pairs = [(source, model) for model in models]
    return mean_simulation(evaluator.models.simulate_scored(pairs, blocks))


def error_on(evaluator: Evaluator, y_hat: Simulation, blocks: Sequence[Segment]) -> Score:
    """Score a simulation in the search's metric over the standard deviations of all training
    records."""
    data = evaluator.data
    y = [block.y for block in blocks]
    return combine([score_fold(y, y_hat, data.scale, data.rule.metric)])


@dataclass(frozen=True)
class Gate:
    """Asks the guard records, and a fit of one fold at a time, whether a gain in V is real."""

    problem: Problem
    evaluator: Evaluator
    store: Store
    _known: dict[int, Simulation | CandidateError] = field(
        default_factory=dict[int, Simulation | CandidateError]
    )
    """Simulations of the guard records by experiment, or why there is none; 0 for the training
    mean."""

    def confirm(self, source: str, evaluation: Evaluation, view: SearchView) -> Confirmation | None:
        """Confirm the gain of a candidate that is about to be a new best. None where V alone is
        evidence: the agent cannot read the training records, or did not write the candidate."""
        score = evaluation.outcome
        if not view.started.gate or not view.finished or not isinstance(score, Score):
            return None
        since, before = self._counted_from(view.bests[::-1], view)
        if before is None:
            return None
        try:
            sequential = self._sequential(source, view)
            y_hat = None
            if view.started.guard_digest is not None:
                models = [evaluation.artifacts.get(fold.model) for fold in evaluation.folds]
                y_hat = simulated(self.evaluator, source, models, self._blocks)
            found = self._judged(since, before, score.value, y_hat, view)
        except CandidateError as error:
            gain = share_gained(before, score.value)
            return Confirmation(since, gain, detail=error.reason.value)
        if sequential is None:
            return found
        return replace(found, sequential=share_gained(before, sequential))

    def admits(self, e: Experiment, best: Experiment, view: SearchView) -> bool:
        """Return whether a candidate that was no new best may be handed over beside the best one:
        on the guard records it may be worse by half of what it is worse in V."""
        if e.unconfirmed:
            return False
        alone = Stack((StackMember(e.number, 1.0),), e.score.value if e.score else 0.0, ())
        return self.confirms_stack(alone, best, view)

    def confirms_stack(self, stack: Stack, best: Experiment, view: SearchView) -> bool:
        """Return whether the guard records confirm the gain in V of a stack over the best
        candidate: members that are worse alone can hold each other's errors with another sign."""
        if view.started.guard_digest is None or not view.started.gate or best.score is None:
            return True
        try:
            simulations = [self._simulation(m.experiment, view) for m in stack.members]
            weights = [m.weight for m in stack.members]
            y_hat = tuple(
                np.tensordot(weights, np.stack(each), axes=1)
                for each in zip(*simulations, strict=True)
            )
            found = self._judged(best.number, best.score.value, stack.value, y_hat, view)
        except CandidateError:
            return False
        return found.confirmed

    def look(self, view: SearchView) -> GuardLooked:
        """Score the last three new bests on the guard records when the search ends, and compare
        the gain of the last one since the first with that in V. Where the same ones were looked at
        before, nothing new is learned and the look is not counted again."""
        bests = view.bests[-NEW_BESTS:]
        last = view.looks[-1] if view.looks else None
        if last is not None and [s.experiment for s in last.scores] == [e.number for e in bests]:
            return last
        scores = tuple(GuardScore(e.number, self._outcome(e, view)) for e in bests)
        values = [(s.outcome.value, s.experiment) for s in scores if isinstance(s.outcome, Score)]
        pick = min(values)[1] if values else None
        total, best = None, bests[-1]
        since, before = self._counted_from([e for e in view.bests if e != best], view)
        if best.score is not None and before is not None:
            value = best.score.value
            try:
                y_hat = self._simulation(best.number, view)
                total = self._judged(since, before, value, y_hat, view)
            except CandidateError as error:
                total = Confirmation(since, share_gained(before, value), detail=error.reason.value)
        return GuardLooked(1 + (last.look if last else 0), scores, pick, total=total)

    def _counted_from(
        self, bests: Sequence[Experiment], view: SearchView
    ) -> tuple[int, float | None]:
        """Number and V of what a gain is counted from: the first of these that can simulate the
        guard records; the training mean for none."""
        for e in bests:
            failed = view.started.guard_digest is not None and isinstance(
                self._outcome(e, view), Failure
            )
            if e.score is not None and not failed:
                return e.number, e.score.value
        return 0, view.reference_value(MEAN_REFERENCE)

    def _judged(
        self, since: int, before: float, value: float, y_hat: Simulation | None, view: SearchView
    ) -> Confirmation:
        """Compare a gain in V with that of a simulation of the guard records. Raises
        CandidateError."""
        gain = share_gained(before, value)
        if y_hat is None:
            return Confirmation(since, gain)
        first, highest = self._counted_from(view.bests, view)
        left = 1.0 - self._gain(self._simulation(first, view), y_hat).value
        highest = highest or before
        apart = left * highest / max(value, _ROUNDING * highest)
        found = self._gain(self._simulation(since, view), y_hat)
        return Confirmation(since, gain, found, apart=apart)

    def _sequential(self, source: str, view: SearchView) -> float | None:
        """V with the folds fitted one after the other, each in namespaces of its own, so that none
        can tell another one anything; None where they were, or where no code but that of the
        library runs. Raises CandidateError."""
        if view.started.isolation_strict or library_only(source):
            return None
        values: list[float] = []
        random = np.random.default_rng(self.evaluator.models.check_seed(source, "sequential"))
        for place in random.permutation(len(self.evaluator.data.folds)).tolist():
            with self.evaluator.workers.fresh_workers():
                outcome = self.evaluator.fit_fold(source, place)
            if isinstance(outcome, Failure):
                raise CandidateError(outcome.reason, outcome.detail)
            values.append(outcome.value)
        return float(np.mean(values))

    @cached_property
    def _blocks(self) -> tuple[Segment, ...]:
        return tuple(whole(open_guard(self.problem), self.problem.protocol))

    def _simulation(self, number: int, view: SearchView) -> Simulation:
        """Simulation of the guard records by the fold models of an experiment. Raises
        CandidateError."""
        if number not in self._known:
            if number:
                e = view.experiment(number)
                models = [self.store.get(fold.model) for fold in e.folds]
                source = self.store.text(e.source)
                try:
                    self._known[number] = simulated(self.evaluator, source, models, self._blocks)
                except CandidateError as error:
                    self._known[number] = error
            else:
                records = self.evaluator.data.records
                mean = np.nanmean(np.concatenate([one.measured_y for one in records]), axis=0)
                self._known[0] = tuple(np.tile(mean, (len(b.y), 1)) for b in self._blocks)
        known = self._known[number]
        if isinstance(known, CandidateError):
            raise known
        return known

    def _outcome(self, e: Experiment, view: SearchView) -> Outcome:
        try:
            return error_on(self.evaluator, self._simulation(e.number, view), self._blocks)
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def _gain(self, before: Simulation, after: Simulation) -> Interval:
        data, y = self.evaluator.data, [block.y for block in self._blocks]
        return paired_gain([ComparedParts(y, before, after, data.scale)], data.rule.metric)
