"""Confirmation: the top candidates fitted again from other seeds, and ranked."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.fold_fits import derive_seed
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, same_simulations
from asia.judge.scoring.repeated_fits import (
    Interval,
    RepeatedFits,
    block_values,
    corrected_level,
    expected_error,
    expected_of_ensemble,
    noise_of_seeds,
    paired_difference,
    value_interval,
)
from asia.ledger.artifacts import Store, without_artifacts
from asia.ledger.chain import Chain
from asia.ledger.events import Confirmed, ConfirmedCandidate, ConfirmedPair, Fit
from asia.ledger.simulated import fold_outputs
from asia.ledger.verification import check_lock
from asia.ledger.view import Experiment, SearchView
from asia.problem.load import load_lock
from asia.search.run import LOCK, make_evaluator

# Statistics of repeated fits for a confirmation: ranks, differences, expected error.


LEVEL: Final = 0.95
EXPECTED_LEVEL: Final = 0.9


@dataclass(frozen=True)
class TriedCandidate:
    """A candidate with a score."""

    experiment: int
    first: RepeatedFits
    """The fit of the search."""
    repeats: tuple[Fit, ...] = ()
    """Fits from other seeds; () of a candidate that was not repeated."""

    @property
    def deterministic(self) -> bool:
        """Return whether fits do not depend on the seed."""
        return any(repeat.same for repeat in self.repeats)

    @property
    def fits(self) -> RepeatedFits | None:
        """Its repeats, or the first fit if all are equal; None if all repeats failed."""
        if self.deterministic:
            return self.first
        sound = [r for r in self.repeats if r.value is not None]
        if not sound:
            return None
        values = np.array([r.folds for r in sound])
        return RepeatedFits(values, even_blocks([r.blocks for r in sound]))


def rank(view: SearchView, tried: Sequence[TriedCandidate], top: int, seeds: int) -> Confirmed:
    """Rank the first `top` candidates by their repeats.

    Differences hold simultaneously over as many comparisons as a choice among all candidates makes,
    or over the pairs if these are more.
    """
    assert view.best is not None
    repeated = {candidate.experiment: candidate for candidate in tried[:top]}
    known = {number: candidate.fits for number, candidate in repeated.items()}
    judged = {number: fits for number, fits in known.items() if fits is not None}
    order = sorted(judged, key=lambda number: (judged[number].value, number))
    count = max(len(tried) - 1, len(order) * (len(order) - 1) // 2)
    level = corrected_level(LEVEL, count)
    pairs = tuple(
        ConfirmedPair(a, b, paired_difference(judged[b], judged[a], level))
        for a, b in combinations(order, 2)
    )
    candidates: list[ConfirmedCandidate] = []
    for number in order:
        fits, repeats = judged[number], repeated[number].repeats
        deterministic = repeated[number].deterministic
        failed = sum(r.value is None for r in repeats)
        candidates.append(
            ConfirmedCandidate(
                experiment=number,
                first=repeated[number].first.value,
                value=value_interval(fits, LEVEL),
                spread=0.0 if deterministic else fits.spread,
                repeats=len(repeats) - failed,
                failed=failed,
                deterministic=deterministic,
                best_rank=1 + sum(pair.apart for pair in pairs if pair.second == number),
                worst_rank=len(order) - sum(pair.apart for pair in pairs if pair.first == number),
            )
        )
    # Over candidates whose fits depend on the seed; 0 where none does.
    random = [judged[n] for n, one in repeated.items() if n in judged and not one.deterministic]
    # The expected error is that of the fit that is handed over, including the effect of its seed.
    best = next(c.first for c in tried if c.experiment == view.best.number)
    blocks = even_blocks([candidate.first.blocks[0].tolist() for candidate in tried])
    seed = derive_seed(view.started.seed, "confirm")
    expected = expected_error(best, blocks, EXPECTED_LEVEL, seed)
    # Not known where the search did not compare its fold models on the training records.
    check = None if view.refitted is None else view.refitted.check
    ensemble: Interval | None = None
    if check is not None and check.ensemble_error is not None:
        errors = [error for error in check.fold_errors if error is not None]
        if len(errors) == len(check.fold_errors):
            ensemble = expected_of_ensemble(expected, errors, check.ensemble_error)
    return Confirmed(
        best=view.best.number,
        seeds=seeds,
        tried=len(tried),
        level=LEVEL,
        candidates=tuple(candidates),
        pairs=pairs,
        noise=noise_of_seeds(random) if random else 0.0,
        expected=expected,
        expected_level=EXPECTED_LEVEL,
        ensemble=ensemble,
        failed=tuple(number for number, fits in known.items() if fits is None),
        after_unsealing=view.unsealing is not None,
    )


def even_blocks(each: Sequence[Sequence[Sequence[float]]]) -> Array:
    """Block values (fits, folds, blocks). Where a fold is so short that it has fewer blocks than
    another, all have as many as that."""
    fewest = min(len(fold) for one in each for fold in one)
    return np.array([[fold[:fewest] for fold in one] for one in each])


# Fit the top candidates of a finished search again from other seeds, and say what that shows.
#
# It reads training records alone. A search that was opened may be confirmed too, for a paper needs
# the seeds whether the test was opened or not; the event says that it came after.


OnRepeat = Callable[[Fit, int, int], None]


def confirm(
    directory: Path,
    on_repeat: OnRepeat,
    *,
    top: int = 3,
    seeds: int = 5,
    isolation: Isolation | None = None,
) -> tuple[Confirmed, bool]:
    """Repeat the fits of the `top` candidates with the lowest V, and rank them; True where the
    ledger had no such result yet.

    Each repeat is an event of the ledger: one that is there is not fitted again, whether the
    command was killed or asks for more seeds now. on_repeat: called after each fit with its event,
    the number of fits that are done, and that of all there may be. isolation: level of the
    candidates; None for the strongest of this machine.

    Raises UserError when the search is not finished, has no candidate with a score, or came without
    its artifacts.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        check_repeatable(directory, view, "a confirmation")
        chosen = scored(view)
        store = Store(directory / "artifacts")
        problem = load_lock(directory / LOCK)
        evaluator = make_evaluator(problem, view, isolation=isolation)
        metric = problem.protocol.metric
        work = _Confirmation(chain, store, evaluator, metric, seeds, on_repeat)
        top = min(top, len(chosen))
        work.repeat_all(chosen[:top])
        tried = [work.tried(experiment) for experiment in chosen]
        found = rank(chain.view, tried, top, seeds)
        if chain.view.confirmed == found:
            return found, False
        chain.append(found)
        return found, True


def scored(view: SearchView) -> list[Experiment]:
    """The candidates with a score and a source of their own, the lowest V first."""
    found = [
        (e.score.value, e.number)
        for e in view.finished
        if e.score is not None and e.result is not None and e.result.duplicate_of is None
        if not e.unconfirmed
    ]
    return [view.experiment(number) for _, number in sorted(found)]


def check_repeatable(directory: Path, view: SearchView, what: str) -> None:
    """Raises UserError unless candidates of a finished search can be fitted again; what: for."""
    check_lock(directory, view.started)
    run = view.started.run
    if not view.complete:
        raise UserError(f"run '{run}' is not finished: {what} comes after a search")
    if view.best is None:
        raise UserError(f"run '{run}' has no candidate with a score, so nothing to fit again")
    if not Store(directory / "artifacts").kept:
        raise UserError(without_artifacts(directory))


@dataclass(frozen=True)
class _Confirmation:
    """A confirmation under way."""

    chain: Chain
    store: Store
    evaluator: Evaluator
    metric: str
    seeds: int
    on_repeat: OnRepeat

    @property
    def _repeats(self) -> list[Fit]:
        return [fit for fit in self.chain.view.fits if fit.purpose == "confirmation"]

    def repeat_all(self, chosen: list[Experiment]) -> None:
        """Fit all seeds of each candidate in sequence."""
        total, done, data = len(chosen) * self.seeds, 0, self.evaluator.data
        known = {(fit.experiment, fit.seed): fit for fit in self._repeats}
        with self.evaluator.workers.ready_workers():
            for experiment in chosen:
                source = self.store.text(experiment.source)
                for repeat in range(1, self.seeds + 1):
                    done += 1
                    event = known.get((experiment.number, repeat))
                    if event is None:
                        begin = time.monotonic()
                        found = self.evaluator.evaluate(source, repeat)
                        seconds = time.monotonic() - begin
                        event = Fit(
                            repeat, "confirmation", experiment=experiment.number, seconds=seconds
                        )
                        if isinstance(found.outcome, Failure):
                            event = replace(event, failed=found.outcome.reason.value)
                        else:
                            y_hat = fold_outputs(found.artifacts, found.folds, data.folds)
                            event = replace(
                                event,
                                value=found.outcome.value,
                                folds=tuple(fold.value for fold in found.outcome.folds),
                                blocks=self._blocks(y_hat),
                                same=same_simulations(experiment.folds, found.folds),
                            )
                        self.chain.append(event)
                        self.on_repeat(event, done, total)
                    if event.same:
                        # One repeat shows it: the others would be the same.
                        done += self.seeds - repeat
                        break

    def _blocks(self, y_hats: Sequence[tuple[Array, ...]]) -> tuple[tuple[float, ...], ...]:
        """Parts of the held-out blocks of each fold in the score."""
        return tuple(
            tuple(
                block_values(
                    [block.y for block in fold.held_out], y_hat, fold.scale, self.metric
                ).tolist()
            )
            for fold, y_hat in zip(self.evaluator.data.folds, y_hats, strict=True)
        )

    def tried(self, experiment: Experiment) -> TriedCandidate:
        """The first fit of a candidate and all that was repeated of it."""
        assert experiment.score is not None
        values = np.array([[fold.value for fold in experiment.score.folds]])
        found = fold_outputs(self.store, experiment.folds, self.evaluator.data.folds)
        blocks = even_blocks([self._blocks(found)])
        repeats = tuple(
            r for r in self._repeats if r.experiment == experiment.number and r.seed <= self.seeds
        )
        return TriedCandidate(experiment.number, RepeatedFits(values, blocks), repeats)
