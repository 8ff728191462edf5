"""Evaluator: folds, sandbox and scoring in one composition."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from typing import Protocol, TypeAlias

import numpy as np

from asia._heap import LARGE_RECORDS, give_back_large_arrays
from asia._timer import Activity
from asia.candidate import Context, check_source, executed_source
from asia.data.trajectory import Array, Trajectory, spread_of
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.findings import fold_result
from asia.judge.evaluation.pruning import FoldPruner
from asia.judge.evaluation.relations import (
    ROUNDING,
    Suspicion,
    SuspicionKind,
    dependences,
    objection_to,
    sequential_objection,
    strangers,
    suspicions,
)
from asia.judge.evaluation.remote import FoldFitter
from asia.judge.evaluation.requests import MOST_TRAINING_WINDOWS, simulate_held_out, spread
from asia.judge.evaluation.results import (
    Evaluation,
    FoldEnd,
    FoldResult,
    Refit,
    RefitModel,
    derive_seed,
)
from asia.judge.evaluation.validation_score import Oracle
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import Executor, remote_executor_of
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import Failure, combine
from asia.judge.scoring.residuals import ranges_of
from asia.lowering.program import LoweredModel
from asia.problem.budget import Budget
from asia.problem.protocol import Block, Fold, ProtocolRule, whole

_Ask: TypeAlias = Callable[[Worker, Sequence[Block], Sequence[Array]], Sequence[Suspicion]]

_STRANGERS_ASKED = 4
# Training samples of a fold.
_LONG = 100_000


class _OpenWorker(Protocol):
    def __call__(self, source: str, *, fitting: bool) -> AbstractContextManager[Worker]: ...


@dataclass(frozen=True)
class _Contexts:
    """Contexts of fits and of loaded models, each with its own seed and deadline."""

    search: Context
    """Context of the search."""
    fit_seconds: float
    """Longest fit."""

    def of(self, work: str, start: int = 0) -> Context:
        """Context of some work, `all` or `load`; start: as in `Evaluator.evaluate`."""
        return replace(
            self.search,
            seed=derive_seed(self.search.seed, work, start),
            deadline=time.monotonic() + self.fit_seconds,
        )


@dataclass(frozen=True)
class _StoredModels:
    """Fitted models as bytes, each loaded in a fresh worker. Methods raise CandidateError."""

    open_worker: _OpenWorker
    """Opens a worker for a candidate."""
    contexts: _Contexts
    """Contexts of loaded models."""
    horizon: int | None
    """Samples of a window; None where whole records are simulated."""

    def load(self, worker: Worker, source: str, model: bytes) -> None:
        """Load a model in a worker."""
        worker.load(executed_source(source), model, self.contexts.of("load"))

    def simulate(self, source: str, model: bytes, blocks: Sequence[Block]) -> tuple[Array, ...]:
        """Simulations of blocks."""
        with self.open_worker(source, fitting=False) as worker:
            self.load(worker, source, model)
            return simulate_held_out(worker, blocks, self.horizon)

    def answers(
        self, source: str, model: bytes, blocks: Sequence[Block]
    ) -> tuple[Array, ...] | CandidateError:
        """Simulations of blocks, or the error."""
        try:
            return self.simulate(source, model, blocks)
        except CandidateError as error:
            return error

    def lowered(self, source: str, model: bytes) -> LoweredModel | str:
        """The model as a program, or why it cannot be lowered."""
        with self.open_worker(source, fitting=False) as worker:
            self.load(worker, source, model)
            return worker.lowered(self.contexts.of("load"))


@dataclass(frozen=True)
class _AnswerChecks:
    """Checks of answers in fresh workers: whether each is that of a model, and depends on nothing
    that it must not depend on."""

    stored: _StoredModels
    """Loads models."""
    scale: Array
    """Standard deviation (ny,) of the measured outputs of all records."""
    search_seed: int
    """Seed of the search."""
    salt: str
    """As in `Evaluator`."""
    without: frozenset[SuspicionKind]
    """Relations that are not checked."""

    def seed(self, source: str, *parts: object) -> int:
        """Seed of the requests, another one for each source: the result of a check tells a
        candidate nothing about the next one."""
        return derive_seed(self.search_seed, self.salt, source, *parts)

    def fold_objection(self, source: str, fold: Fold, result: FoldResult) -> Failure | None:
        """Failure of a fold model that does not answer like a model."""
        place = fold.index + 1
        followed = [i for i, known in enumerate(fold.followed) if known]
        ask = partial(
            suspicions, scale=fold.scale, horizon=self.stored.horizon,
            seed=self.seed(source, place), followed=followed, without=self.without, rounding=0.0,
        )  # fmt: skip
        try:
            found = self._asked(source, result.model, fold.validation, result.y_hat, ask)
        except CandidateError as error:
            return Failure(error.reason, error.detail, place)
        return objection_to(found, place)

    def refit_objection(
        self, source: str, model: bytes, blocks: Sequence[Block], y_hat: Sequence[Array]
    ) -> Failure | None:
        """Failure of a model fitted on all records that does not answer like a model there. Raises
        CandidateError."""
        ask = partial(
            suspicions, scale=self.scale, horizon=self.stored.horizon, rounding=0.0,
            seed=self.seed(source, "refit"),
            without={*self.without, SuspicionKind.RESTART, SuspicionKind.BLOCK_END},
        )  # fmt: skip
        return objection_to(self._asked(source, model, blocks, y_hat, ask), None)

    def simulate(
        self, source: str, model: bytes, blocks: Sequence[Block]
    ) -> tuple[Array, ...] | CandidateError:
        """Simulations of blocks that will be scored, or the error; reason SUSPECT where an answer
        depends on something that it must not depend on."""
        ask = partial(
            dependences, scale=self.scale, horizon=self.stored.horizon, without=self.without,
            seed=self.seed(source, "other"), rounding=0.0,
        )  # fmt: skip
        try:
            y_hat = self.stored.simulate(source, model, blocks)
            failure = objection_to(self._asked(source, model, blocks, y_hat, ask), None)
        except CandidateError as error:
            return error
        return y_hat if failure is None else CandidateError(failure.reason, failure.detail)

    def check_strangers(
        self, source: str, fold: Fold, model: bytes, y_hat: Sequence[Array]
    ) -> None:
        """Repeat a few cases in a fresh worker where several requests share one. Raises
        CandidateError where its answers differ."""
        horizon = self.stored.horizon
        if horizon is None or SuspicionKind.STRANGERS in self.without:
            return

        def ask(
            worker: Worker, blocks: Sequence[Block], y_hat: Sequence[Array]
        ) -> Sequence[Suspicion]:
            seed = self.seed(source, fold.index, "strangers")
            found = strangers(
                worker, blocks, y_hat, fold.scale, horizon, seed, 0.0, _STRANGERS_ASKED
            )
            return () if found is None else (found,)

        failure = objection_to(self._asked(source, model, fold.validation, y_hat, ask), None)
        if failure is not None:
            raise CandidateError(failure.reason, failure.detail)

    def _asked(
        self,
        source: str,
        model: bytes,
        blocks: Sequence[Block],
        y_hat: Sequence[Array],
        ask: _Ask,
    ) -> Sequence[Suspicion]:
        """Suspicions that `ask` finds in a worker that has seen no case. Raises CandidateError,
        with reason NOT_REPRODUCIBLE where not even the scored order gives the scored answers."""
        with self.stored.open_worker(source, fitting=False) as worker:
            try:
                self.stored.load(worker, source, model)
            except CandidateError as error:
                raise CandidateError(Reason.NOT_REPRODUCIBLE, str(error)) from None
            try:
                found = ask(worker, blocks, y_hat)
            except CandidateError as error:
                detail = f"next to the scored cases: {error.detail or error.reason.advice}"
                raise CandidateError(error.reason, detail) from None
        kind = SuspicionKind.STRANGERS
        if any(one.kind is kind for one in found):
            again = self.stored.simulate(source, model, blocks)
            pairs = zip(again, y_hat, strict=True)
            if any(one.tobytes() != other.tobytes() for one, other in pairs):
                raise CandidateError(Reason.NOT_REPRODUCIBLE)
        return [one for one in found if one.kind is not kind or one.figure > ROUNDING]


class Evaluator(WorkerRunner):
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
        salt: str = "",
        without: Collection[SuspicionKind] = (),
        problem: str = "",
        *,
        gpu: bool = False,
    ) -> None:
        """salt: a text that no candidate or agent knows, so that none can predict which cases are
        checked; without: relations that are not checked, to show what each of them finds; problem:
        sha256 of the run's lock file; gpu: whether workers that train networks compute on the GPU.
        Raises UserError where folds would be fitted on other machines and candidates may ask for
        scores, which takes the held-out outputs there."""
        limits = Limits(budget.fit_seconds, budget.fit_seconds, budget.memory_mb)
        super().__init__(isolation, limits, executor, len(folds), gpu=gpu)
        self.folds = tuple(folds)
        self.horizon = rule.horizon
        self.records = tuple(records)
        self.training_blocks = spread(whole(records, rule), MOST_TRAINING_WINDOWS)
        self.scale = spread_of(np.concatenate([record.measured_y for record in records]))
        self._context = context
        self._rule = rule
        self._contexts = _Contexts(context, limits.fit_seconds)
        self._stored = _StoredModels(self._worker_for, self._contexts, rule.horizon)
        self._checks = _AnswerChecks(
            self._stored, self.scale, context.seed, salt, frozenset(without)
        )
        self._salt = salt
        self._analysing = threading.Lock()
        self._fitter = FoldFitter(
            rule, context, isolation, remote_executor_of(executor), problem, self.is_sequential
        )  # fmt: skip
        if sum(r.u.nbytes + r.y.nbytes for r in records) > LARGE_RECORDS:
            give_back_large_arrays()
        self._ranges = ranges_of([r.u for r in records], [r.y for r in records])

    @property
    def may_fit_ahead(self) -> bool:
        """Whether fits that turn out not to be needed may be made: not one by one, nor where each
        of them may ask for validation scores, which are counted."""
        return not self.is_sequential and self._rule.early_stopping == "inner"

    def evaluate(self, source: str, start: int = 0) -> Evaluation:
        """Fit and simulate `source` on every fold. A failed fold fails the candidate. start: fits
        from another start have seeds of their own, the same for all candidates; 0 in a search."""
        return self._evaluate(source, start, None)

    def evaluate_first(self, source: str, over: float | None) -> Evaluation:
        """As `evaluate`, for a first fit. over: no fold is begun once V must be above it, those
        under way are ended, and the outcome is a Failure with reason BEHIND; None where every
        fold counts."""
        if over is None:
            return self.evaluate(source)
        return self._evaluate(source, 0, FoldPruner(len(self.folds), over))

    def _evaluate(self, source: str, start: int, pruner: FoldPruner | None) -> Evaluation:
        try:
            check_source(source)
            source = executed_source(source)
        except CandidateError as error:
            return Evaluation(Failure(error.reason, error.detail))
        jobs = [partial(self._fold_or_failure, source, fold, start) for fold in self.folds]
        try:
            if pruner is None:
                ends = self._run(jobs)
            else:
                cancellable = map(partial, repeat(self.cancellable), pruner.cancels, jobs)
                fits = [partial(pruner.fit, i, job) for i, job in enumerate(cancellable)]
                ends = [end for end in self._run(fits) if end is not None]
        except CandidateError as error:
            return Evaluation(Failure(error.reason, error.detail))
        behind = None if pruner is None else pruner.failure()
        if pruner is not None and behind is not None:
            return Evaluation(behind, output=ends[0].output, ended_folds=pruner.ended)
        calls = sum(end.validation_scores for end in ends)
        for end in ends:
            if isinstance(end.result, Failure):
                return Evaluation(end.result, output=end.output, validation_scores=calls)
        folds = tuple(end.result for end in ends if isinstance(end.result, FoldResult))
        return Evaluation(combine([f.score for f in folds]), folds, ends[0].output, calls)

    def objection(self, source: str, folds: Sequence[FoldResult]) -> Failure | None:
        """Load every fold's model in a fresh worker; a Failure unless each simulates bitwise the
        same as the worker that fitted it, and answers like a model (see `suspicions`), and unless V
        stays where it is far below the training error."""
        found = self.objection_to_answers(source, folds)
        return self.objection_to_consistency(source, folds) if found is None else found

    def objection_to_answers(self, source: str, folds: Sequence[FoldResult]) -> Failure | None:
        """The part of `objection` for which nothing is fitted. RESTART depends on held-out outputs:
        it is the reason only if no other relation fails in any fold."""
        jobs = [
            partial(self._checks.fold_objection, source, f, r)
            for f, r in zip(self.folds, folds, strict=True)
        ]
        try:
            with self.stopwatch.activity(Activity.CHECKS, swallows=True):
                found = [f for f in self._run(jobs) if f is not None]
            return min(found, key=lambda f: f.reason is Reason.RESTART, default=None)
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def objection_to_consistency(self, source: str, folds: Sequence[FoldResult]) -> Failure | None:
        """The part of `objection` with fits one after the other: no worker of the same candidate
        may run beside it."""
        if SuspicionKind.CONSISTENCY in self._checks.without:
            return None

        def fit_sequentially(place: int) -> FoldResult | Failure:
            job = partial(self._fold_or_failure, source, self.folds[place])
            return self._run([job])[0].result

        random = np.random.default_rng(self._checks.seed(source, "consistency"))
        try:
            with self.stopwatch.activity(Activity.CHECKS, swallows=True):
                return sequential_objection(folds, fit_sequentially, random)
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def refit(self, source: str) -> Refit:
        """Fit on all training records, and on one of the folds a second time."""
        source = executed_source(source)
        fold = self.folds[derive_seed(self._context.seed, self._salt) % len(self.folds)]
        models: list[RefitModel | CandidateError] = []
        results: list[FoldResult | Failure] = []
        self._run(
            [
                lambda: models.append(self._fit_all(source, 0)),
                lambda: results.append(self._fold_or_failure(source, fold).result),
            ]
        )
        return Refit(models[0], fold.index + 1, results[0])

    def refit_again(self, source: str, start: int) -> RefitModel | CandidateError:
        """Fit on all training records with the seed of another start; 0 is that of `refit`."""
        return self._run([partial(self._fit_all, executed_source(source), start)])[0]

    def _fit_all(self, source: str, start: int) -> RefitModel | CandidateError:
        """Nothing is held out, so the candidate has no validation score to ask for."""
        model: bytes | None = None
        try:
            with self._worker_for(source, fitting=True) as worker:
                worker.fit(source, self.records, self._contexts.of("all", start))
                model = worker.dump()
                return RefitModel(model, worker.estimates())
        except CandidateError as error:
            # A model is none the worse for estimates that cannot be had.
            return error if model is None else RefitModel(model)

    def simulate_training(
        self, source: str, models: Sequence[bytes]
    ) -> list[tuple[Array, ...] | CandidateError]:
        """Simulate `training_blocks` with stored models; an error where one fails."""
        blocks = self.training_blocks
        return self._run([partial(self._stored.answers, source, model, blocks) for model in models])

    def refit_objection(self, source: str, model: bytes, y_hat: Sequence[Array]) -> Failure | None:
        """As `objection`, for a model fitted on all records and its answers to `training_blocks`:
        without what asks how it does outside the records that it was fitted on."""
        blocks = self.training_blocks
        job = partial(self._checks.refit_objection, source, model, blocks, y_hat)
        try:
            with self.stopwatch.activity(Activity.CHECKS, swallows=True):
                return self._run([job])[0]
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def simulate(
        self, source: str, models: Sequence[bytes], blocks: Sequence[Block]
    ) -> list[tuple[Array, ...]]:
        """Simulate `blocks` with stored models, each in a fresh worker. Raises CandidateError."""
        jobs = [partial(self._stored.simulate, source, model, blocks) for model in models]
        return self._run(jobs)

    def simulate_scored(
        self, source: str, models: Sequence[bytes], blocks: Sequence[Block]
    ) -> list[tuple[Array, ...] | CandidateError]:
        """As `simulate`, for answers that will be scored: a second worker is asked as `dependences`
        does. For each model its simulations, or what it did: reason SUSPECT where an answer depends
        on what it must not."""
        jobs = [partial(self._checks.simulate, source, model, blocks) for model in models]
        return self._run(jobs)

    def lowered(self, source: str, models: Sequence[bytes]) -> list[LoweredModel | str]:
        """Stored models as programs that can be printed, each traced in a fresh worker; for one
        that cannot be lowered, why. Raises CandidateError."""
        return self._run([partial(self._stored.lowered, source, model) for model in models])

    def _fold_or_failure(self, source: str, fold: Fold, start: int = 0) -> FoldEnd:
        opening = partial(self._worker_for, source, fitting=False)
        oracle = Oracle(opening, source, self._context, fold, self._rule)
        inner = self._rule.early_stopping == "inner"
        found = self._fitter.fit(
            source, fold, start, self._worker, None if inner else oracle, self.stopwatch,
            self.settings.cancel, self.limits_for(source),
        )  # fmt: skip
        try:
            fitted = found.result
            if isinstance(fitted, CandidateError):
                raise fitted
            with self.stopwatch.activity(Activity.CHECKS, swallows=True):
                self._checks.check_strangers(source, fold, fitted.model, fitted.y_hat)
            with self.stopwatch.activity(Activity.SCORE), self._analysis_lock(fold):
                result = fold_result(
                    fold, fitted, self._rule, self._ranges, self._context, oracle.calls
                )
                result = replace(
                    result, machine=found.machine, isolation=found.isolation, device=fitted.device
                )
        except CandidateError as error:
            result = Failure(error.reason, error.detail, fold.index + 1)
        return FoldEnd(result, found.printed, oracle.calls)

    def _analysis_lock(self, fold: Fold) -> AbstractContextManager[object]:
        """Analyse one fold of long records at a time, to limit memory."""
        long = sum(len(record) for record in fold.train) > _LONG
        return self._analysing if long else nullcontext()
