"""The one composition: folds -> sandbox -> scoring -> outcome."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from asia.candidate import Context, check_source
from asia.errors import CandidateError, Reason, SandboxError
from asia.evaluation._oracle import Oracle
from asia.evaluation._requests import simulate_held_out, simulate_training
from asia.executor import Executor
from asia.problem import Array, Budget, ProtocolRule, Trajectory
from asia.protocol import Block, Fold, whole
from asia.sandbox import FitReply, Isolation, Limits, Worker, open_worker
from asia.scoring import (
    METRICS,
    Diagnostics,
    Failure,
    FoldScore,
    Outcome,
    combine,
    diagnose,
    score_fold,
)

T = TypeVar("T")


@dataclass(frozen=True)
class FoldResult:
    """What one fold left behind. `model` is opaque; `y_hat` holds one (H, ny) array a held-out
    block; `curve` (n, 2) is step and loss as logged by the candidate; `seconds` is its fit;
    `validation_scores` is how often it was told its score on the held-out part."""

    score: FoldScore
    model: bytes
    y_hat: tuple[Array, ...]
    curve: Array
    diagnostics: Diagnostics
    seconds: float
    validation_scores: int = 0


@dataclass(frozen=True)
class Evaluation:
    """Outcome of one candidate; `folds` is empty after a failure. `output` is what the
    candidate printed while fitting, capped and stripped. `validation_scores` counts those of all
    folds, failed ones too."""

    outcome: Outcome
    folds: tuple[FoldResult, ...] = ()
    output: str = ""
    validation_scores: int = 0


@dataclass(frozen=True)
class _FoldEnd:
    result: FoldResult | Failure
    output: str
    validation_scores: int


def derive_seed(root: int, *parts: object) -> int:
    """31-bit seed from the search seed and what it is for, by sha256."""
    text = ":".join(str(p) for p in (root, *parts))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1


class Evaluator:
    """Judges candidates on the folds of one problem, each fold in a fresh sandboxed worker."""

    def __init__(
        self,
        folds: Sequence[Fold],
        records: Sequence[Trajectory],
        context: Context,
        rule: ProtocolRule,
        budget: Budget,
        isolation: Isolation,
        executor: Executor,
    ) -> None:
        self.folds = tuple(folds)
        self.horizon = rule.horizon
        self._records = tuple(records)
        self._context = context
        self._rule = rule
        self.isolation = isolation
        self._executor = executor
        self._open: set[Worker] = set()
        self._interrupted = False
        self._limits = Limits(budget.fit_seconds, budget.fit_seconds, budget.memory_mb)

    def evaluate(self, source: str) -> Evaluation:
        """Fit and simulate `source` on every fold. A failed fold fails the candidate."""
        try:
            check_source(source)
        except CandidateError as error:
            return Evaluation(Failure(error.reason, error.detail))
        jobs = [partial(self._guarded_fold, source, fold) for fold in self.folds]
        ends = self._run(jobs)
        calls = sum(end.validation_scores for end in ends)
        for end in ends:
            if isinstance(end.result, Failure):
                return Evaluation(end.result, validation_scores=calls)
        folds = tuple(end.result for end in ends if isinstance(end.result, FoldResult))
        return Evaluation(combine([f.score for f in folds]), folds, ends[0].output, calls)

    def reload_differs(self, source: str, folds: Sequence[FoldResult]) -> Failure | None:
        """Load every fold's model in a fresh worker; a Failure unless each simulates bitwise the
        same as the worker that fitted it."""

        def check(fold: Fold, result: FoldResult) -> Failure | None:
            try:
                again = self._simulate_model(source, result.model, fold.validation)
            except CandidateError as error:
                return Failure(Reason.NOT_REPRODUCIBLE, str(error), fold.index + 1)
            same = all(a.tobytes() == b.tobytes() for a, b in zip(again, result.y_hat, strict=True))
            return None if same else Failure(Reason.NOT_REPRODUCIBLE, "", fold.index + 1)

        jobs = [partial(check, f, r) for f, r in zip(self.folds, folds, strict=True)]
        return next((f for f in self._run(jobs) if f is not None), None)

    def refit(self, source: str) -> bytes:
        """Fit on all training records; the opaque model. Nothing is held out, so that the
        candidate has no validation score to ask for. Raises CandidateError."""

        def fit() -> bytes:
            with self._worker() as worker:
                worker.fit(source, self._records, self._fold_context("all"))
                return worker.dump()

        return self._run([fit])[0]

    def simulate(
        self, source: str, models: Sequence[bytes], blocks: Sequence[Block]
    ) -> list[tuple[Array, ...]]:
        """Simulate `blocks` with stored models, each in a fresh worker. Raises CandidateError."""
        jobs = [partial(self._simulate_model, source, model, blocks) for model in models]
        return self._run(jobs)

    def _run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results of the jobs; a sandbox that fails is tried once more. Workers still open at the
        end are those of an interrupted run."""
        try:
            return self._executor.run([partial(self._twice, job) for job in jobs])
        finally:
            self._interrupted = bool(self._open)
            for worker in list(self._open):
                worker.abort()

    def _twice(self, job: Callable[[], T]) -> T:
        try:
            return job()
        except SandboxError:
            if self._interrupted:
                raise
            return job()

    @contextmanager
    def _worker(self) -> Generator[Worker]:
        with open_worker(self.isolation, self._limits) as worker:
            self._open.add(worker)
            try:
                if self._interrupted:
                    raise SandboxError("the search was interrupted")
                yield worker
            finally:
                self._open.discard(worker)

    def _fold_context(self, fold: object) -> Context:
        return replace(
            self._context,
            seed=derive_seed(self._context.seed, fold, 0),
            deadline=time.monotonic() + self._limits.fit_seconds,
        )

    def _guarded_fold(self, source: str, fold: Fold) -> _FoldEnd:
        oracle = Oracle(self._worker, source, self._context, fold, self._rule)
        try:
            result, output = self._run_fold(source, fold, oracle)
        except CandidateError as error:
            result, output = Failure(error.reason, error.detail, fold.index + 1), ""
        return _FoldEnd(result, output, oracle.calls)

    def _run_fold(self, source: str, fold: Fold, oracle: Oracle) -> tuple[FoldResult, str]:
        metric = self._rule.metric
        inside = whole(fold.train, self._rule)
        with self._worker() as worker:
            reply = self._fit(worker, source, fold, oracle)
            model = worker.dump()
            y_hat = simulate_held_out(worker, fold.validation, self.horizon)
            train_y_hat = simulate_training(worker, inside, self.horizon)
        score = score_fold([b.y for b in fold.validation], y_hat, fold.scale, metric)
        train_y = [b.y for b in inside]
        train = score_fold(train_y, train_y_hat, fold.scale, metric)
        evidence = diagnose(
            [b.case.u for b in inside], train_y, train_y_hat, fold.scale, train.value
        )
        result = FoldResult(score, model, y_hat, reply.curve, evidence, reply.seconds, oracle.calls)
        return result, reply.output

    def _fit(self, worker: Worker, source: str, fold: Fold, oracle: Oracle) -> FitReply:
        context = self._fold_context(fold.index)
        if self._rule.early_stopping == "inner":
            return worker.fit(source, fold.train, context)
        with oracle:
            return worker.fit(source, fold.train, context, oracle)

    def _simulate_model(
        self, source: str, model: bytes, blocks: Sequence[Block]
    ) -> tuple[Array, ...]:
        with self._worker() as worker:
            worker.load(source, model, self._fold_context("load"))
            return simulate_held_out(worker, blocks, self.horizon)


def score_outputs(
    folds: Sequence[Fold], outputs: Sequence[Sequence[Array]], metric: str
) -> Outcome:
    """Score given simulations, one (H, ny) array a held-out block of each fold."""
    if metric not in METRICS:
        raise KeyError(metric)
    scores = [
        score_fold([b.y for b in fold.validation], y_hat, fold.scale, metric)
        for fold, y_hat in zip(folds, outputs, strict=True)
    ]
    return combine(scores)
