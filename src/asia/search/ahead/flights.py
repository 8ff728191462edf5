"""First fits that run while others are proposed and decided, a thread each.

A first fit depends on its source alone, so it may begin at once. The decision on it depends on the
results before it, and is made in its turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from asia._stopwatch import Lane
from asia.evaluation import Evaluation, Evaluator
from asia.ledger import Experiment, Landed, Proposed, SearchView, Store
from asia.search.ahead.landed import evaluation_of, landed_of


@dataclass(frozen=True)
class Flown:
    """A first fit that is over."""

    evaluation: Evaluation
    """Result of the evaluation."""
    seconds: float
    """Its duration."""
    lane: Lane
    """Profile of the evaluation."""


class Flights:
    """The first fits under way. With one experiment at a time there are none."""

    def __init__(
        self,
        at_once: int,
        evaluator: Evaluator,
        store: Store,
        on_landed: Callable[[Landed], None],
    ) -> None:
        """at_once: experiments in flight; on_landed: called, from the thread of a fit, once it has
        ended."""
        self._evaluator, self._store, self._on_landed = evaluator, store, on_landed
        self._under_way: dict[int, Future[Flown]] = {}
        self._pool = ThreadPoolExecutor(at_once, "experiment") if at_once > 1 else None

    @property
    def any(self) -> bool:
        """Return whether a pending fit was not collected yet."""
        return bool(self._under_way)

    def launch(self, view: SearchView) -> None:
        """Begin whatever was proposed and is not under way. A twin of an earlier candidate waits:
        it has the outcome of that one."""
        if self._pool is None:
            return
        for e in view.running:
            if e.number in self._under_way or e.landed is not None or _has_twin(e, view):
                continue
            self._under_way[e.number] = self._pool.submit(self._fly, e.proposed)

    def take(self, experiment: Experiment) -> Flown | None:
        """The first fit of an experiment, waited for, whatever it raised; None where it was not
        begun."""
        under_way = self._under_way.get(experiment.number)
        if under_way is not None:
            flown = under_way.result()
            del self._under_way[experiment.number]
            return flown
        landed = experiment.landed
        if landed is None:
            return None
        evaluation = evaluation_of(landed, self._evaluator.folds, self._store)
        return Flown(evaluation, landed.seconds, Lane())

    def close(self) -> None:
        """End what is under way; it is begun again with the search."""
        if self._pool is None:
            return
        if not all(one.done() for one in self._under_way.values()):
            self._evaluator.abort()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _fly(self, proposed: Proposed) -> Flown:
        source = self._store.text(proposed.source)
        begin = time.monotonic()
        with self._evaluator.stopwatch.aside() as lane:
            evaluation = self._evaluator.evaluate_first(source, proposed.over)
        seconds = time.monotonic() - begin
        self._on_landed(landed_of(proposed.experiment, evaluation, seconds, self._store))
        return Flown(evaluation, seconds, lane)


def _has_twin(experiment: Experiment, view: SearchView) -> bool:
    """Return whether the same normalised source was proposed before."""
    digest = experiment.proposed.digest
    earlier = (e for e in view.experiments if e.number < experiment.number)
    return any(e.proposed.digest == digest for e in earlier)
