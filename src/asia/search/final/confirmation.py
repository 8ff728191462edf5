"""Fit the top candidates of a finished search again from other seeds, and say what that shows.

It reads training records alone. A search that was opened may be confirmed too, for a paper needs
the seeds whether the test was opened or not; the event says that it came after.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia.data import Array
from asia.errors import UserError
from asia.evaluation import Evaluator, same_simulations
from asia.ledger import (
    Chain,
    Confirmed,
    Experiment,
    Repeated,
    SearchView,
    Store,
    check_lock,
    without_artifacts,
)
from asia.problem.load import load_lock
from asia.protocol import Fold
from asia.scoring import RepeatedFits, Score, block_values
from asia.search._run import LOCK, make_evaluator
from asia.search.final.ranking import TriedCandidate, even_blocks, rank

OnRepeat = Callable[[Repeated, int, int], None]


def confirm(
    directory: Path, on_repeat: OnRepeat, *, top: int = 3, seeds: int = 5
) -> tuple[Confirmed, bool]:
    """Repeat the fits of the `top` candidates with the lowest V, and rank them; True where the
    ledger had no such result yet.

    Each repeat is an event of the ledger: one that is there is not fitted again, whether the
    command was killed or asks for more seeds now. on_repeat: called after each fit with its event,
    the number of fits that are done, and that of all there may be.

    Raises UserError when the search is not finished, is with ladder feedback, has no candidate with
    a score, or came without its artifacts.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        check_repeatable(directory, view, "a confirmation")
        chosen = scored(view)
        store = Store(directory / "artifacts")
        problem = load_lock(directory / LOCK)
        evaluator = make_evaluator(problem, view)
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
        (e.score.value, e.number, e)
        for e in view.finished
        if e.score is not None and e.result is not None and e.result.duplicate_of is None
    ]
    return [e for _, _, e in sorted(found, key=lambda one: one[:2])]


def check_repeatable(directory: Path, view: SearchView, what: str) -> None:
    """Raises UserError unless candidates of a finished search can be fitted again; what: for."""
    check_lock(directory, view.started)
    run = view.started.run
    if view.started.ladder is not None:
        raise UserError(
            f"run '{run}' has ladder feedback, which hides the exact V: {what} would print "
            "it, so use guard records or the sealed test to tell its candidates apart"
        )
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

    def repeat_all(self, chosen: list[Experiment]) -> None:
        """Fit all seeds of each candidate in sequence."""
        total, done = len(chosen) * self.seeds, 0
        with self.evaluator.ready_workers():
            for experiment in chosen:
                for repeat in range(1, self.seeds + 1):
                    event = self._observed(experiment.number, repeat)
                    done += 1
                    if event is None:
                        event = self._repeat(experiment, repeat)
                        self.chain.append(event)
                        self.on_repeat(event, done, total)
                    if event.same:
                        # One repeat shows it: the others would be the same.
                        done += self.seeds - repeat
                        break

    def _observed(self, experiment: int, repeat: int) -> Repeated | None:
        for event in self.chain.view.repeats:
            if (event.experiment, event.repeat) == (experiment, repeat):
                return event
        return None

    def _repeat(self, experiment: Experiment, repeat: int) -> Repeated:
        begin = time.monotonic()
        found = self.evaluator.evaluate(self.store.text(experiment.proposed.source), repeat)
        seconds = time.monotonic() - begin
        if not isinstance(found.outcome, Score):
            return Repeated(experiment.number, repeat, found.outcome, seconds=seconds)
        blocks = tuple(
            self._blocks(fold, result.y_hat)
            for fold, result in zip(self.evaluator.folds, found.folds, strict=True)
        )
        same = same_simulations(self._simulations(experiment), found.y_hats)
        return Repeated(experiment.number, repeat, found.outcome, blocks, same, seconds)

    def _simulations(self, experiment: Experiment) -> list[tuple[Array, ...]]:
        """Return the simulations of each fold's held-out blocks from the search."""
        assert experiment.result is not None
        return [
            self.store.get_arrays(kept.y_hat, [block.y.shape for block in fold.validation])
            for kept, fold in zip(experiment.result.folds, self.evaluator.folds, strict=True)
        ]

    def _blocks(self, fold: Fold, y_hat: tuple[Array, ...]) -> tuple[float, ...]:
        y = [block.y for block in fold.validation]
        return tuple(block_values(y, y_hat, fold.scale, self.metric).tolist())

    def tried(self, experiment: Experiment) -> TriedCandidate:
        """The first fit of a candidate and all that was repeated of it."""
        assert experiment.score is not None
        pairs = zip(self.evaluator.folds, self._simulations(experiment), strict=True)
        blocks = tuple(self._blocks(fold, y_hat) for fold, y_hat in pairs)
        repeats = tuple(
            r
            for r in self.chain.view.repeats
            if r.experiment == experiment.number and r.repeat <= self.seeds
        )
        values = np.array([[fold.value for fold in experiment.score.folds]])
        return TriedCandidate(
            experiment.number, RepeatedFits(values, even_blocks([blocks])), repeats
        )
