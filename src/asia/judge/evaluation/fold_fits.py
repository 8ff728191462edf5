"""Fits of folds: what a fit is given, the fit in a sandboxed worker, and its record."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Generic, Protocol, TypeVar

import numpy as np

from asia._diagnostic import diagnostic
from asia._timer import Activity
from asia.candidate import Context, KnownSystem
from asia.data.segment import Segment
from asia.data.trajectory import Array, Trajectory
from asia.errors import CandidateError
from asia.judge.artifacts import ArtifactStore
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.requests import (
    secret_of,
    sessions,
    side_by_side,
    simulate_each,
    simulate_training,
)
from asia.judge.evaluation.training_checks import training_checks
from asia.judge.evaluation.validation_score import Oracle
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.sandbox.programs import program_store
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.checks.check import RecordedCheck
from asia.judge.scoring.outcome import FoldRecord, StepErrors, score_fold
from asia.judge.scoring.residuals import (
    Diagnostics,
    Ranges,
    SignedResidual,
    diagnose,
    signed_residuals,
)
from asia.problem.folds import Fold, whole
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.problem.protocol import ProtocolRule

_MOST_RESIDUALS = 120
# Processor time of a simulation of the training records from which on it is not repeated.
_SLOW_SECONDS = 2.0

# What a fit is given.


def derive_seed(root: int, *parts: object) -> int:
    """Derive a 31-bit seed from the search seed and a purpose, by sha256."""
    text = ":".join(str(p) for p in (root, *parts))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1


def known_system(problem: Problem) -> KnownSystem:
    """Return what candidates and agents know of a problem, its signals as fits receive them."""
    rule = problem.protocol
    return KnownSystem(
        inputs=problem.preprocess.signals(problem.inputs),
        outputs=problem.preprocess.signals(problem.outputs),
        sampling_time=problem.sampling_time,
        n_past_u=rule.past_inputs,
        n_past_y=rule.past_outputs,
        horizon=rule.horizon,
        metric=rule.metric,
        physics=problem.physics,
        symmetry=problem.symmetry,
        loop=problem.loop,
        plant=problem.plant,
        control=problem.control and problem.control.task(),
        responses=problem.responses,
    )


def search_context(problem: Problem, seed: int) -> Context:
    """Return the context of a search with this derived seed, without the fields that differ by
    fold."""
    # Of a control problem: signals and equations of its plant, and the task.
    system = known_system(problem.identification)
    system = replace(system, control=known_system(problem).control)
    kept = problem.identification.preprocess
    return Context(**system.known(), detrend=kept.detrend, scale=kept.scale, seed=seed)


@dataclass(frozen=True)
class FoldData:
    """Data for the fit of a fold, the same for all candidates.

    Of the held-out outputs it has the past windows, which candidates receive, and a digest.
    """

    train: tuple[Trajectory, ...]
    held_out: tuple[Segment, ...]
    """The segments without their outputs."""
    sessions: tuple[tuple[int, ...], ...]
    """Cases of each worker, in order: see `requests.sessions`."""
    secret: bytes | None
    """A digest of the held-out outputs, see `requests.simulate_each`."""
    rule: ProtocolRule


def fold_data(fold: Fold, rule: ProtocolRule) -> FoldData:
    """Collect the data of a fold: everything but the outputs that it holds out."""
    blocks = fold.held_out
    return FoldData(
        train=fold.train,
        held_out=tuple(block.unmeasured for block in blocks),
        sessions=tuple(map(tuple, sessions(blocks))),
        secret=secret_of(blocks),
        rule=rule,
    )


# The fit.


M = TypeVar("M")


@dataclass(frozen=True, repr=False)
class FoldFit(Generic[M]):
    """A model fitted on one fold and its simulations, as the process that fits reports them."""

    model: M
    """The fitted model; as bytes never parsed outside a sandbox."""
    curve: Array
    """Step and loss as logged by the candidate, (n, 2), may hold NaN."""
    printed: str
    """Text that the candidate printed during the fit."""
    seconds: float
    """Wall time of the fit."""
    parameters: tuple[tuple[str, float], ...]
    y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each held-out block."""
    train_y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each block of the training records."""
    memory_mb: float | None = None
    """The largest address space of the worker before its first case."""
    compile_seconds: float = 0.0
    """Time in which JAX traced and compiled before the first case."""
    numbers: int | None = None
    """Count of the numbers in the model; None if not known."""
    simulate_seconds: float = 0.0
    """Processor time of the second simulation of the training records; of the first where it is
    slow."""
    machine: str = ""
    """The machine that fitted it; "" for the search's own."""
    isolation: str = ""
    """The level that was in force there; "" for the search's own."""

    def __repr__(self) -> str:
        return f"<model and simulations of {len(self.y_hat)} held-out blocks>"


class OpenWorker(Protocol):
    """Opener of workers for a candidate."""

    def __call__(self, source: str, *, fitting: bool) -> AbstractContextManager[Worker]:
        """Open one, to fit it or to load its models."""
        ...


def fit_fold(
    source: str,
    context: Context,
    data: FoldData,
    open_worker: OpenWorker,
    fit_seconds: float,
    oracle: Oracle | None = None,
    on_loss: Callable[[float, float], None] | None = None,
) -> FoldFit[bytes]:
    """Fit in one worker, which reports its parameters before it receives a case, and simulate there
    and in fresh ones.

    Args:
        context: with the seed of the fit; its deadline is set here
        oracle: scores the model on the held-out part during the fit, where the protocol allows
            it; it has the held-out outputs, so it exists only on the search's own machine
        on_loss: called with a step and its loss while the fit runs

    Raises:
        CandidateError: with what the candidate printed
        SandboxError: for a failure that the candidate did not cause
    """
    printed = ""
    try:
        with open_worker(source, fitting=True) as worker:
            context = replace(context, deadline=time.monotonic() + fit_seconds)
            try:
                with oracle or nullcontext():
                    curve, _, seconds = worker.fit(
                        source, data.train, context, oracle, program_store(), on_loss
                    )
            finally:
                printed = worker.printed
            parameters, model = worker.parameters(), worker.dump()
            # Before the first case: later a candidate could let held-out values decide on them.
            memory, compiling = worker.peak_memory_mb, worker.compile_seconds()
            numbers = worker.numbers()
            # Before the held-out cases too: the residuals on the training records are reported.
            inside = whole(data.train, data.rule)
            train_y_hat = simulate_training(worker.simulate_known, inside, data.rule.horizon)
            first = simulating = worker.spent[Activity.SIMULATE][1]
            # The first one also compiles and loads: a second one shows the time of a sample.
            if first < _SLOW_SECONDS:
                simulate_training(worker.simulate_known, inside, data.rule.horizon)
                simulating = worker.spent[Activity.SIMULATE][1] - first
            blocks, (own, *others) = data.held_out, data.sessions
            together = side_by_side(source, data.rule)
            found = simulate_each(worker, blocks, own, data.secret, together=together)
        for session in others:
            with open_worker(source, fitting=False) as fresh:
                fresh.load(source, model, context)
                found |= simulate_each(fresh, blocks, session, data.secret, together=together)
    except CandidateError as error:
        raise CandidateError(error.reason, error.detail, printed) from error
    return FoldFit(
        model=model,
        curve=curve,
        printed=printed,
        seconds=seconds,
        parameters=parameters,
        y_hat=tuple(np.ascontiguousarray(found[i], "<f8") for i in range(len(data.held_out))),
        train_y_hat=tuple(np.ascontiguousarray(one, "<f8") for one in train_y_hat),
        memory_mb=memory,
        compile_seconds=compiling,
        numbers=numbers,
        simulate_seconds=simulating,
    )


class FoldFitter:
    """Fits the folds of one search on this machine."""

    def __init__(
        self,
        rule: ProtocolRule,
        context: Context,
        workers: WorkerRunner,
        without: Collection[SuspicionKind] = (),
    ) -> None:
        """Prepare the folds of a search.

        Args:
            rule: protocol of the problem
            context: part of the context that is the same for all folds
            workers: runs the fits
            without: as in `EvaluatorOptions`
        """
        self._rule, self._context, self._workers = rule, context, workers
        self._without = without
        self._data: dict[int, FoldData] = {}

    def fit(self, source: str, fold: Fold, start: int, oracle: Oracle | None) -> FoldFit[bytes]:
        """Fit `source` on a fold; start: another one has another seed. The cancel flag of this
        thread ends it. Raises CandidateError and SandboxError."""
        if fold.index not in self._data:
            data = fold_data(fold, self._rule)
            if SuspicionKind.LOOK_AHEAD in self._without:
                data = replace(data, secret=None)
            if SuspicionKind.STRANGERS in self._without:
                data = replace(data, sessions=(tuple(chain(*data.sessions)),))
            self._data[fold.index] = data
        context = replace(self._context, seed=derive_seed(self._context.seed, fold.index, start))
        return self._fit(source, context, fold, oracle)

    def _fit(
        self, source: str, context: Context, fold: Fold, oracle: Oracle | None
    ) -> FoldFit[bytes]:
        workers = self._workers
        shown = workers.on_loss and partial(workers.on_loss, source, fold.index + 1)
        return fit_fold(
            source, context, self._data[fold.index], workers.open_for, workers.fit_seconds,
            oracle, shown,
        )  # fmt: skip


# Its record.


def record_fold(
    fold: Fold,
    fitted: FoldFit[bytes],
    rule: ProtocolRule,
    ranges: Ranges,
    context: Context,
    validation_scores: int,
    artifacts: ArtifactStore,
) -> FoldRecord:
    """Score a fold's simulations, analyse their residuals, and keep the large parts in `artifacts`.
    An analysis that raises leaves a line in `failed`, and zeros in `Diagnostics`; a score that
    raises is not caught.

    Raises:
        CandidateError: for outputs that are not finite or too large to analyse
    """
    inside = whole(fold.train, rule)
    y, train_y = [b.y for b in fold.held_out], [b.y for b in inside]
    score = score_fold(y, fitted.y_hat, fold.scale, rule.metric)
    train = score_fold(train_y, fitted.train_y_hat, fold.scale, rule.metric)
    inputs = [b.u for b in inside]
    whole_y = [
        b.simulated(one).complete_y for b, one in zip(inside, fitted.train_y_hat, strict=True)
    ]
    failed: list[str] = []
    evidence = Diagnostics(train.value)
    signed: tuple[SignedResidual, ...] = ()
    held_out: tuple[SignedResidual, ...] = ()
    steps: tuple[StepErrors, ...] = ()
    checks: tuple[RecordedCheck, ...] | None = None
    # The errors of a closed loop are no residuals of a model.
    if rule.kind != "control":
        with diagnostic("residual analysis", failed):
            evidence = diagnose(inputs, whole_y, fitted.train_y_hat, fold.scale, train.value)
        with diagnostic("signed residuals", failed):
            signed = signed_residuals(inputs, whole_y, fitted.train_y_hat, fold.scale, ranges)
        with diagnostic("held-out residuals", failed):
            held_out = _held_out_residuals(fold, fitted, rule, ranges)
        with diagnostic("errors by step", failed):
            steps = _step_errors(fold, fitted.y_hat, rule)
        with diagnostic("training checks", failed):
            checks = training_checks(inside, fitted.train_y_hat, fold.scale, context)
    return replace(
        score,
        model=artifacts.put(fitted.model),
        y_hat=artifacts.put_arrays(fitted.y_hat),
        curve=artifacts.put_arrays([fitted.curve]),
        diagnostics=evidence,
        fit_seconds=fitted.seconds,
        validation_scores=validation_scores,
        machine=fitted.machine,
        isolation=fitted.isolation,
        errors=_errors(y, fitted.y_hat, fold.scale, rule),
        train_errors=_errors(train_y, fitted.train_y_hat, fold.scale, rule),
        steps=steps,
        residuals=signed[:_MOST_RESIDUALS],
        held_out_residuals=held_out,
        parameters=fitted.parameters,
        checks=checks,
        failed=tuple(failed),
        printed=fitted.printed,
        compile_seconds=fitted.compile_seconds,
        memory_mb=fitted.memory_mb,
        numbers=fitted.numbers,
        sample_seconds=fitted.simulate_seconds / sum(map(len, fitted.train_y_hat)),
    )


def _held_out_residuals(
    fold: Fold, fitted: FoldFit[bytes], rule: ProtocolRule, ranges: Ranges
) -> tuple[SignedResidual, ...]:
    if rule.residuals == "train":
        return ()
    u = [b.u for b in fold.held_out]
    y = [b.simulated(one).complete_y for b, one in zip(fold.held_out, fitted.y_hat, strict=True)]
    return signed_residuals(u, y, fitted.y_hat, fold.scale, ranges)[:_MOST_RESIDUALS]


def _errors(
    y: Sequence[Array], y_hat: Sequence[Array], scale: Array, rule: ProtocolRule
) -> tuple[float, ...]:
    a, b = np.concatenate(list(y)), np.concatenate(list(y_hat))
    return tuple(find_metric(rule.metric).shortfalls(a, b, scale).tolist())


def _step_errors(fold: Fold, y_hat: Sequence[Array], rule: ProtocolRule) -> tuple[StepErrors, ...]:
    """Return the errors at the steps that the table of the test lists too."""
    if rule.horizon is None:
        return ()
    found: list[StepErrors] = []
    for step in rule.test.horizons:
        y, simulated = (
            [one[step - 1 : step] for one in parts]
            for parts in ((block.y for block in fold.held_out), y_hat)
        )
        found.append(StepErrors(step, _errors(y, simulated, fold.scale, rule)))
    return tuple(found)
