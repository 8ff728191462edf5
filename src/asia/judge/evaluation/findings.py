"""Findings of one fold: its score and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from asia._diagnostic import diagnostic
from asia.candidate import Context, KnownSystem
from asia.data.trajectory import Array
from asia.judge.artifacts import ArtifactStore
from asia.judge.evaluation.training_checks import training_checks
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


M = TypeVar("M")


@dataclass(frozen=True)
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
