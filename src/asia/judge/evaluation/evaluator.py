"""Evaluator: folds, sandbox and scoring in one composition."""

import threading
import time
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain
from typing import TypeAlias, TypeVar

import numpy as np

from asia._heap import LARGE_RECORDS, give_back_large_arrays
from asia._timer import Activity
from asia.candidate import Context, ParameterEstimates, check_source, executed_source, library_only
from asia.data.segment import Segment, stacked
from asia.data.trajectory import Array, Trajectory, spread_of
from asia.errors import CandidateError, Reason, UserError
from asia.judge.artifacts import ArtifactStore
from asia.judge.evaluation.fold_fits import FoldFitter, derive_seed, record_fold
from asia.judge.evaluation.relations import (
    ROUNDING,
    Suspicion,
    SuspicionKind,
    objection_to,
    strangers,
    suspicions,
)
from asia.judge.evaluation.remote import RemoteFoldFitter
from asia.judge.evaluation.requests import (
    MOST_TRAINING_WINDOWS,
    secret_of,
    sessions,
    side_by_side,
    simulate_each,
    spread,
)
from asia.judge.evaluation.validation_score import Oracle
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.sandbox.programs import program_store
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.outcome import Failure, FoldRecord, Outcome, Score, combine, score_parts
from asia.judge.scoring.residuals import ranges_of
from asia.lowering.program import LoweredModel
from asia.problem.folds import Fold, inner_folds, whole
from asia.problem.protocol import ProtocolRule

T = TypeVar("T")
Simulator: TypeAlias = Callable[[Array, Array, Array], Array]
"""Past inputs (B, n, nu), past outputs (B, n, ny) and inputs (B, H, nu) -> outputs (M, B, H, ny) of
M models, not finite where one diverges."""
_Ask: TypeAlias = Callable[[Worker, Sequence[Segment], Sequence[Array]], Sequence[Suspicion]]

_STRANGERS_ASKED = 4
# Training samples of a fold.
_LONG = 100_000


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of one candidate on all folds, or on one of them."""

    outcome: Outcome
    output: str = ""
    """Text that the candidate printed during the first fold's fit, or that of a fold that failed,
    capped and stripped."""
    validation_scores: int = 0
    """Number of scores on held-out parts that the candidate requested, in all folds, failed ones
    included."""
    artifacts: ArtifactStore = field(default_factory=ArtifactStore, repr=False, compare=False)
    """The large parts of `folds`."""

    @property
    def folds(self) -> tuple[FoldRecord, ...]:
        """The records of all folds; empty if one of them failed."""
        return self.outcome.folds

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """Diagnostics that raised an exception, each line once, whatever the number of folds."""
        return tuple(dict.fromkeys(line for one in self.folds for line in one.failed))


@dataclass(frozen=True)
class RefitModel:
    """A model fitted on all training records."""

    model: bytes
    """The model; never parsed outside a sandbox."""
    estimates: ParameterEstimates | None = None
    """Parameter estimates of the model; None where it offers none."""


@dataclass(frozen=True)
class Refit:
    """A candidate fitted on all training records, and on one fold a second time."""

    model: RefitModel | CandidateError
    """The model fitted on all training records, or why there is none."""
    fold: int
    """The number of the fold that was fitted again, from 1."""
    again: Outcome
    """The outcome of that fold."""


@dataclass(frozen=True)
class EvaluationData:
    """Data that all candidates of a search are judged on."""

    folds: tuple[Fold, ...]
    records: tuple[Trajectory, ...]
    context: Context
    """Context of the search: seed and deadline differ by fit."""
    rule: ProtocolRule

    @property
    def horizon(self) -> int | None:
        """Samples of a window; None where whole records are simulated."""
        return self.rule.horizon

    @cached_property
    def inner_folds(self) -> tuple[Fold, ...]:
        """Folds within the training records of the folds; () where these are too short, and where
        fits ask for their score on what is held out."""
        try:
            inner = self.rule.early_stopping == "inner"
            return inner_folds(self.folds, self.rule) if inner else ()
        except UserError:
            return ()

    @cached_property
    def training_blocks(self) -> tuple[Segment, ...]:
        """Blocks of the training records that refitted models are compared on."""
        return spread(whole(self.records, self.rule), MOST_TRAINING_WINDOWS)

    @cached_property
    def scale(self) -> Array:
        """Standard deviation (ny,) of the measured outputs of all records, or the tolerance that
        the protocol has instead."""
        if self.rule.tolerance is not None:
            return np.array(self.rule.tolerance)
        return spread_of(np.concatenate([record.measured_y for record in self.records]))


@dataclass(frozen=True)
class EvaluatorOptions:
    """Options of the evaluator of one search."""

    salt: str = ""
    """A text that no candidate or agent knows, so that none can predict which cases are checked."""
    without: Collection[SuspicionKind] = ()
    """Relations that are not checked, to show what each of them finds."""
    problem: str = ""
    """sha256 of the run's lock file."""


class StoredModels:
    """Fitted models as bytes, each loaded in a fresh worker."""

    def __init__(
        self, data: EvaluationData, workers: WorkerRunner, options: EvaluatorOptions
    ) -> None:
        self._data, self._workers, self._options = data, workers, options

    def simulate(
        self, source: str, models: Sequence[bytes], blocks: Sequence[Segment]
    ) -> list[tuple[Array, ...]]:
        """Simulate `blocks` with each model. Raises CandidateError."""
        return self._workers.run([partial(self._simulate, source, m, blocks) for m in models])

    def simulate_training(
        self, source: str, models: Sequence[bytes]
    ) -> list[tuple[Array, ...] | CandidateError]:
        """Simulate the training blocks; an error where a model fails."""

        def answers(model: bytes) -> tuple[Array, ...] | CandidateError:
            try:
                return self._simulate(source, model, self._data.training_blocks)
            except CandidateError as error:
                return error

        return self._workers.run([partial(answers, model) for model in models])

    def simulate_together(
        self, source: str, models: Sequence[bytes], blocks: Sequence[Segment]
    ) -> list[Array | CandidateError]:
        """Simulate blocks of one length in one request; outputs (blocks, H, ny) of each model, or
        an error where it fails. For cases without measured outputs only."""
        cases = stacked(blocks)

        def answers(model: bytes) -> Array | CandidateError:
            try:
                with self._loaded(source, model) as worker:
                    return worker.simulate_known(cases.past_u, cases.past_y, cases.u)
            except CandidateError as error:
                return error

        return self._workers.run([partial(answers, model) for model in models])

    def with_simulators(
        self, members: Sequence[tuple[str, Sequence[bytes]]], job: Callable[[Simulator], T]
    ) -> T:
        """Call `job` with a function that simulates cases with all models of all sources, in one
        worker a source that stays open. For cases without measured outputs only. Raises
        CandidateError."""

        def run() -> T:
            with ExitStack() as opened:
                workers = [
                    (opened.enter_context(self._loaded(source, models[0])), source, models)
                    for source, models in members
                ]

                def simulate(past_u: Array, past_y: Array, u: Array) -> Array:
                    found: list[Array] = []
                    for worker, source, models in workers:
                        for model in models:
                            if len(models) > 1:
                                worker.load(executed_source(source), model, self._data.context)
                            found.append(worker.simulate_unchecked(past_u, past_y, u))
                    return np.stack(found)

                return job(simulate)

        return self._workers.run([run])[0]

    def simulate_scored(
        self, models: Sequence[tuple[str, bytes]], blocks: Sequence[Segment]
    ) -> list[tuple[Array, ...] | CandidateError]:
        """As `simulate`, for answers that will be scored, of models each with its source: with a
        fresh worker for each of the `sessions`, and with some cases asked again in another one. For
        each model its simulations, or what it did: reason SUSPECT where an answer depends on cases
        before it."""

        def checked(source: str, model: bytes) -> tuple[Array, ...] | CandidateError:
            ask = partial(
                strangers, secret=self.secret_of(blocks), scale=self._data.scale,
                seed=self.check_seed(source, "other"), rounding=0.0,
            )  # fmt: skip
            try:
                y_hat = self._simulate_sessions(source, model, blocks, sessions(blocks))
                if SuspicionKind.STRANGERS in self.left_out(source):
                    return y_hat
                failure = objection_to(self.ask(source, model, blocks, y_hat, ask), None)
            except CandidateError as error:
                return error
            return y_hat if failure is None else CandidateError(failure.reason, failure.detail)

        return self._workers.run([partial(checked, *one) for one in models])

    def lowered(
        self, source: str, models: Sequence[bytes], parameters: Sequence[str] = ()
    ) -> list[LoweredModel | str]:
        """Models as programs that can be printed, each traced in a fresh worker; for one that
        cannot be lowered, why. Raises CandidateError.

        Args:
            parameters: names of parameters that the last state holds, see
                `asia.lowering.trace.lowered_bytes`
        """

        def lowered(model: bytes) -> LoweredModel | str:
            with self._loaded(source, model) as worker:
                return worker.lowered(self._data.context, parameters)

        return self._workers.run([partial(lowered, model) for model in models])

    def left_out(self, source: str) -> Collection[SuspicionKind]:
        """Relations that are not checked for a source. Code of the library draws no simulation to
        the data after a block, and the past window shows so little of two slow states that
        BLOCK_END would object to an honest model of them. It keeps nothing between cases, which its
        tests check, and its windows are simulated side by side, which changes their last digits."""
        without = {*self._options.without}
        if library_only(source):
            without.add(SuspicionKind.BLOCK_END)
        if side_by_side(source, self._data.rule):
            without |= {SuspicionKind.STRANGERS, SuspicionKind.REPLAY}
        return without

    def check_seed(self, source: str, *parts: object) -> int:
        """Seed of the requests of a check, another one for each source: the result of a check tells
        a candidate nothing about the next one."""
        return derive_seed(self._data.context.seed, self._options.salt, source, *parts)

    def ask(
        self,
        source: str,
        model: bytes,
        blocks: Sequence[Segment],
        y_hat: Sequence[Array],
        ask: _Ask,
        *,
        together: bool = False,
    ) -> Sequence[Suspicion]:
        """Suspicions that `ask` finds in a worker that has seen no case. Raises CandidateError,
        with reason NOT_REPRODUCIBLE where not even the scored order gives the scored answers.

        Args:
            together: whether one worker gave all of them
        """
        with ExitStack() as opened:
            try:
                worker = opened.enter_context(self._loaded(source, model))
            except CandidateError as error:
                raise CandidateError(Reason.NOT_REPRODUCIBLE, str(error)) from None
            try:
                found = ask(worker, blocks, y_hat)
            except CandidateError as error:
                detail = f"next to the scored cases: {error.detail or error.reason.advice}"
                raise CandidateError(error.reason, detail) from None
        kind = SuspicionKind.STRANGERS
        if any(one.kind is kind for one in found):
            if together:
                again = self._simulate(source, model, blocks)
            else:
                again = self._simulate_sessions(source, model, blocks, sessions(blocks))
            pairs = zip(again, y_hat, strict=True)
            if any(one.tobytes() != other.tobytes() for one, other in pairs):
                raise CandidateError(Reason.NOT_REPRODUCIBLE)
        return [one for one in found if one.kind is not kind or one.figure > ROUNDING]

    @contextmanager
    def _loaded(self, source: str, model: bytes) -> Generator[Worker]:
        context = self._data.context
        with self._workers.open_for(source, fitting=False) as worker:
            context = replace(
                context,
                seed=derive_seed(context.seed, "load", 0),
                deadline=time.monotonic() + self._workers.fit_seconds,
            )
            worker.load(executed_source(source), model, context)
            yield worker

    def _simulate(self, source: str, model: bytes, blocks: Sequence[Segment]) -> tuple[Array, ...]:
        return self._simulate_sessions(source, model, blocks, [list(chain(*sessions(blocks)))])

    def _simulate_sessions(
        self, source: str, model: bytes, blocks: Sequence[Segment], parts: Sequence[Sequence[int]]
    ) -> tuple[Array, ...]:
        found: dict[int, Array] = {}
        for part in parts:
            with self._loaded(source, model) as worker:
                found |= simulate_each(
                    worker, blocks, part, self.secret_of(blocks),
                    together=side_by_side(source, self._data.rule),
                )  # fmt: skip
        return tuple(found[i] for i in range(len(blocks)))

    def secret_of(self, blocks: Sequence[Segment]) -> bytes | None:
        """As `requests.secret_of`; None where models may look ahead."""
        return None if SuspicionKind.LOOK_AHEAD in self._options.without else secret_of(blocks)


class Evaluator:
    """Judges candidates on the folds of one problem, each fold in a fresh sandboxed worker."""

    def __init__(
        self, data: EvaluationData, workers: WorkerRunner, options: EvaluatorOptions | None = None
    ) -> None:
        """Raises UserError where folds would be fitted on other machines and candidates may ask for
        scores, which takes the held-out outputs there."""
        self.data, self.workers = data, workers
        self._options = options or EvaluatorOptions()
        self.models = StoredModels(data, workers, self._options)
        self._analysing = threading.Lock()
        # Of sources as they are executed: the linear model is a variant of many candidates.
        self._inner_errors: dict[str, tuple[float, ...] | Reason] = {}
        given = data.rule, data.context, workers
        without = self._options.without
        self._fitter = FoldFitter(*given, without)
        if workers.remote is not None:
            problem = self._options.problem
            self._fitter = RemoteFoldFitter(*given, workers.remote, problem, without)
        if sum(r.u.nbytes + r.y.nbytes for r in data.records) > LARGE_RECORDS:
            give_back_large_arrays()
        self._ranges = ranges_of([r.u for r in data.records], [r.y for r in data.records])

    @property
    def without(self) -> Collection[SuspicionKind]:
        """Relations that are not checked."""
        return self._options.without

    def fit_fold(self, source: str, place: int) -> Outcome:
        """Fit and score a source on one fold, by its place from 0, as in a search."""
        job = partial(self._evaluate_fold, executed_source(source), self.data.folds[place])
        try:
            with self.workers.stopwatch.activity(Activity.CHECKS, swallows=True):
                return self.workers.run([job])[0].outcome
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    @property
    def may_fit_ahead(self) -> bool:
        """Whether fits that turn out not to be needed may be made: not one by one, nor where each
        of them may ask for validation scores, which are counted."""
        return not self.workers.is_sequential and self.data.rule.early_stopping == "inner"

    def evaluate(self, source: str, start: int = 0) -> Evaluation:
        """Fit and simulate `source` on every fold. A failed fold fails the candidate.

        Args:
            start: fits from another start have seeds of their own, the same for all candidates; 0
                in a search
        """
        try:
            check_source(source)
            source = executed_source(source)
        except CandidateError as error:
            return Evaluation(Failure(error.reason, error.detail))
        folds = self.data.folds
        artifacts = ArtifactStore()
        jobs = [partial(self._evaluate_fold, source, fold, start, artifacts) for fold in folds]
        try:
            ends = self.workers.run(jobs)
        except CandidateError as error:
            return Evaluation(Failure(error.reason, error.detail))
        calls = sum(end.validation_scores for end in ends)
        for end in ends:
            if isinstance(end.outcome, Failure):
                return Evaluation(end.outcome, end.output, calls)
        outcome = combine([end.folds[0] for end in ends])
        return Evaluation(outcome, ends[0].output, calls, artifacts)

    def inner_errors(self, source: str) -> tuple[float, ...] | Reason:
        """Fit a source to parts of each fold's training records and simulate the rest.

        Returns:
            the metric, as it enters V, on successive parts of `inner_folds`; the reason where a fit
            or simulation failed
        """
        rule, source = self.data.rule, executed_source(source)

        def parts(fold: Fold) -> tuple[float, ...]:
            fitted = self._fitter.fit(source, fold, 0, None)
            y = [block.y for block in fold.held_out]
            return score_parts(y, fitted.y_hat, fold.scale, rule.metric)

        if source not in self._inner_errors:
            try:
                found = self.workers.run([partial(parts, one) for one in self.data.inner_folds])
                self._inner_errors[source] = tuple(chain.from_iterable(found))
            except CandidateError as error:
                self._inner_errors[source] = error.reason
        return self._inner_errors[source]

    def objection(self, source: str, evaluation: Evaluation) -> Failure | None:
        """Load every fold's model in a fresh worker; a Failure unless each simulates bitwise the
        same as the worker that fitted it, and answers like a model (see `suspicions`). RESTART
        depends on held-out outputs: it is the reason only if no other relation fails in any fold.
        """
        without, store = self.models.left_out(source), evaluation.artifacts

        def objection(fold: Fold, record: FoldRecord) -> Failure | None:
            place, model = fold.index + 1, store.get(record.model)
            y_hat = store.get_arrays(record.y_hat, fold.shapes)
            followed = [i for i, known in enumerate(fold.followed) if known]
            ask = partial(
                suspicions, scale=fold.scale, horizon=self.data.horizon,
                seed=self.models.check_seed(source, place), followed=followed,
                without=without, rounding=0.0,
            )  # fmt: skip
            try:
                found = self.models.ask(source, model, fold.held_out, y_hat, ask)
            except CandidateError as error:
                return Failure(error.reason, error.detail, place)
            return objection_to(found, place)

        pairs = zip(self.data.folds, evaluation.folds, strict=True)
        found = self._run_checks([partial(objection, fold, record) for fold, record in pairs])
        if isinstance(found, Failure):
            return found
        failures = [failure for failure in found if failure is not None]
        return min(failures, key=lambda f: f.reason is Reason.RESTART, default=None)

    def refit_objection(self, source: str, model: bytes, y_hat: Sequence[Array]) -> Failure | None:
        """As `objection`, for a model fitted on all records and its answers to the training blocks:
        without what asks how it does outside the records that it was fitted on."""
        without = {
            *self.models.left_out(source), SuspicionKind.RESTART, SuspicionKind.BLOCK_END,
        }  # fmt: skip
        ask = partial(
            suspicions, scale=self.data.scale, horizon=self.data.horizon, rounding=0.0,
            seed=self.models.check_seed(source, "refit"), without=without,
        )  # fmt: skip
        blocks = self.data.training_blocks
        job = partial(self.models.ask, source, model, blocks, y_hat, ask, together=True)
        found = self._run_checks([job])
        return found if isinstance(found, Failure) else objection_to(found[0], None)

    def refit(self, source: str, fold_models: Sequence[bytes] = ()) -> Refit:
        """Fit on all training records, and on one of the folds a second time.

        Args:
            fold_models: models of the folds, for the families that can start from them
        """
        source = executed_source(source)
        folds = self.data.folds
        fold = folds[derive_seed(self.data.context.seed, self._options.salt) % len(folds)]
        models: list[RefitModel | CandidateError] = []
        outcomes: list[Outcome] = []
        self.workers.run(
            [
                lambda: models.append(self._fit_all(source, 0, fold_models)),
                lambda: outcomes.append(self._evaluate_fold(source, fold).outcome),
            ]
        )
        return Refit(models[0], fold.index + 1, outcomes[0])

    def refit_again(self, source: str, start: int) -> RefitModel | CandidateError:
        """Fit on all training records with the seed of another start; 0 is that of `refit`."""
        return self.workers.run([partial(self._fit_all, executed_source(source), start)])[0]

    def _run_checks(self, jobs: Sequence[Callable[[], T]]) -> list[T] | Failure:
        try:
            with self.workers.stopwatch.activity(Activity.CHECKS, swallows=True):
                return self.workers.run(jobs)
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def _fit_all(
        self, source: str, start: int, fold_models: Sequence[bytes] = ()
    ) -> RefitModel | CandidateError:
        """Nothing is held out, so the candidate has no validation score to ask for."""
        context, model = self.data.context, None
        try:
            with self.workers.open_for(source, fitting=True) as worker:
                context = replace(
                    context,
                    seed=derive_seed(context.seed, "all", start),
                    deadline=time.monotonic() + self.workers.fit_seconds,
                )
                worker.fit(
                    source, self.data.records, context,
                    programs=program_store(), fold_models=fold_models,
                )  # fmt: skip
                model = worker.dump()
                return RefitModel(model, worker.estimates())
        except CandidateError as error:
            # A model is none the worse for estimates that cannot be had.
            return error if model is None else RefitModel(model)

    def _evaluate_fold(
        self, source: str, fold: Fold, start: int = 0, artifacts: ArtifactStore | None = None
    ) -> Evaluation:
        """Fit and score `source` on one fold; artifacts: takes the large parts of its record."""
        context, rule, stopwatch = self.data.context, self.data.rule, self.workers.stopwatch
        opening = partial(self.workers.open_for, source, fitting=False)
        oracle = Oracle(opening, source, context, fold, rule)
        scores = None if rule.early_stopping == "inner" else oracle
        artifacts = ArtifactStore() if artifacts is None else artifacts
        # Analyse one fold of long records at a time, to limit memory.
        long = sum(len(record) for record in fold.train) > _LONG
        printed = ""
        try:
            fitted = self._fitter.fit(source, fold, start, scores)
            printed = fitted.printed
            with stopwatch.activity(Activity.CHECKS, swallows=True):
                self._check_strangers(source, fold, fitted.model, fitted.y_hat)
            with stopwatch.activity(Activity.SCORE), self._analysing if long else nullcontext():
                record = record_fold(
                    fold, fitted, rule, self._ranges, context, oracle.calls, artifacts
                )
            outcome = Score(record.value, (record,))
        except CandidateError as error:
            outcome = Failure(error.reason, error.detail, fold.index + 1)
            printed = printed or error.printed
        return Evaluation(outcome, printed, oracle.calls, artifacts)

    def _check_strangers(
        self, source: str, fold: Fold, model: bytes, y_hat: Sequence[Array]
    ) -> None:
        """Repeat a few cases in a fresh worker where several share one. Raises CandidateError where
        its answers differ."""
        horizon = self.data.horizon
        if horizon is None or SuspicionKind.STRANGERS in self.models.left_out(source):
            return
        ask = partial(
            strangers, secret=self.models.secret_of(fold.held_out), scale=fold.scale,
            rounding=0.0, most=_STRANGERS_ASKED,
            seed=self.models.check_seed(source, fold.index, "strangers"),
        )  # fmt: skip
        failure = objection_to(self.models.ask(source, model, fold.held_out, y_hat, ask), None)
        if failure is not None:
            raise CandidateError(failure.reason, failure.detail)
