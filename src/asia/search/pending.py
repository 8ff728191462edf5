"""Pending evaluations: fits that begin before their results are needed, used in order."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

from asia._timer import Lane
from asia.agents.view import Agent, proposes_ahead
from asia.errors import UserError
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.evaluation.workers import BackgroundJob, JobSettings
from asia.judge.scoring.outcome import Outcome
from asia.ledger.artifacts import Store
from asia.ledger.events import Landed, Proposed
from asia.ledger.view import Experiment, SearchView
from asia.search.fair_trial import Tried, evaluation_of, first_fit


def check_parallel(parallel: int, *, strict: bool) -> None:
    """Raises UserError where so many experiments cannot be evaluated at a time."""
    if parallel < 1:
        raise UserError(f"--parallel {parallel}: expected at least 1")
    if parallel > 1 and strict:
        raise UserError(
            f"--parallel {parallel} with --isolation-strict: strict isolation runs the workers "
            f"sequentially; omit one of the two"
        )


def check_steps_ahead(parallel: int, agent: Agent) -> None:
    """Raises UserError where an agent does not propose ahead of results, but should."""
    if parallel == 1 or proposes_ahead(agent):
        return
    raise UserError(
        f"--parallel {parallel}: the agent {agent.name} proposes one experiment at a time, from "
        f"the result of the one before; omit --parallel. An agent of your own that reads "
        "view.running says so with proposes_ahead = True"
    )


def keep_outcome(store: Store, evaluation: Evaluation) -> Outcome:
    """Store the large parts of the folds as artifacts and return the outcome without them."""
    for fold in evaluation.folds:
        for name in (fold.model, fold.y_hat, fold.curve):
            if evaluation.artifacts is not store:
                store.put(evaluation.artifacts.get(name))
    folds = tuple(fold.stored(store) for fold in evaluation.folds)
    return replace(evaluation.outcome, folds=folds)


def keep_output(store: Store, output: str) -> str | None:
    """Store the output of a candidate as an artifact; return None for an empty output."""
    return store.put(output.encode()) if output else None


def keep_source(store: Store, tried: Tried, proposed: Proposed) -> str | None:
    """Store the variant that was scored as an artifact; return None for the proposed source."""
    name = store.put(tried.source.encode())
    return None if name == proposed.source else name


# First fits that run while others are proposed and decided, a thread each. A first fit depends on
# its source alone, so it may begin at once. The decision on it depends on the results before it,
# and is made in its turn.


@dataclass(frozen=True)
class PendingFit:
    """A first fit that is over."""

    tried: Tried
    seconds: float
    lane: Lane
    """Profile of the evaluation."""


class PendingFits:
    """The first fits under way. With one experiment at a time there are none."""

    def __init__(
        self,
        at_once: int,
        evaluator: Evaluator,
        store: Store,
        on_landed: Callable[[Landed], None],
    ) -> None:
        """on_landed: called from the thread of a fit, once it has ended."""
        self._evaluator, self._store, self._on_landed = evaluator, store, on_landed
        self._under_way: dict[int, Future[PendingFit]] = {}
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
            digest = e.proposed.digest
            twins = (t for t in view.experiments if t.number < e.number)
            begun = e.number in self._under_way or e.landed is not None
            if not begun and all(twin.proposed.digest != digest for twin in twins):
                self._under_way[e.number] = self._pool.submit(self._fit, e.proposed, view)

    def take(self, experiment: Experiment) -> PendingFit | None:
        """Wait for the first fit of an experiment; None where it was not begun."""
        under_way = self._under_way.get(experiment.number)
        if under_way is not None:
            fitted = under_way.result()
            del self._under_way[experiment.number]
            return fitted
        landed = experiment.landed
        if landed is None:
            return None
        evaluation = evaluation_of(landed, self._store)
        source = self._store.text(landed.source or experiment.proposed.source)
        return PendingFit(Tried(source, evaluation, landed.variants), landed.seconds, Lane())

    def close(self) -> None:
        """End what is under way; it is begun again with the search."""
        if self._pool is None:
            return
        if not all(one.done() for one in self._under_way.values()):
            self._evaluator.workers.abort()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _fit(self, proposed: Proposed, view: SearchView) -> PendingFit:
        source = self._store.text(proposed.source)
        begin = time.monotonic()
        with self._evaluator.workers.stopwatch.aside() as lane:
            tried = first_fit(self._evaluator, source, view, proposed, self._store)
        evaluation = tried.evaluation
        seconds = time.monotonic() - begin
        self._on_landed(
            Landed(
                experiment=proposed.experiment,
                outcome=keep_outcome(self._store, evaluation),
                output=keep_output(self._store, evaluation.output),
                seconds=seconds,
                validation_scores=evaluation.validation_scores,
                variants=tried.variants,
                source=keep_source(self._store, tried, proposed),
            )
        )
        return PendingFit(tried, seconds, lane)


# Fits of one candidate from several seeds.


@contextmanager
def retest_fits(
    evaluator: Evaluator, fit: Callable[[int], Evaluation], most: int
) -> Generator[Callable[[int], Evaluation]]:
    """Prefetch fits: yield a function that returns the results of `fit(0)`, `fit(1)`, ... in order.

    Once all folds of one fit have started, the next fit begins; an unused one is cancelled. The
    results do not depend on that. At most `most` fits are made.
    """
    if not evaluator.may_fit_ahead:
        yield fit
        return
    folds = len(evaluator.data.folds)
    fits: list[BackgroundJob[Evaluation]] = []
    begun: list[threading.Semaphore] = []  # released once for each fold of a fit that has begun
    with ExitStack() as opened:

        def begin() -> None:
            number, own = len(fits), threading.Semaphore(0)
            before = begun[-1] if begun else None

            def run() -> Evaluation:
                if before is not None:
                    for _ in range(folds):
                        before.acquire()
                try:
                    return fit(number)
                finally:
                    own.release(folds)

            begun.append(own)
            job = evaluator.workers.background(run, JobSettings(on_begin=own.release))
            fits.append(opened.enter_context(job))

        def take(number: int) -> Evaluation:
            while len(fits) < min(number + 2, most):
                begin()
            return fits[number].result()

        yield take
