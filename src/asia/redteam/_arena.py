"""Evaluation of one cheating candidate with the real evaluator, and detection of its traces."""

from __future__ import annotations

import time
from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

from asia.errors import Reason
from asia.evaluation import Evaluation, Evaluator, SuspicionKind
from asia.executor import Executor, LocalExecutor, SequentialExecutor
from asia.redteam._problem import ProblemName, small_problem
from asia.redteam._types import CandidateAttack, Finding, Observed, SuspicionFinding
from asia.redteam.attacks.source import HONEST, fill_in
from asia.redteam.evidence.targets import Targets, targets
from asia.redteam.evidence.verdict import conclude, said_steps, worst_of
from asia.sandbox import Isolation, Layer, Limits, Worker, layers_in_force, open_worker
from asia.scoring import Failure, Score

_HONEST_SECONDS = 60.0
_HONEST_MB = 2048


class _EvaluatorWithoutLayers(Evaluator):
    """An evaluator whose workers lack some layers; for an outer sandbox only."""

    without: Collection[Layer] = ()
    """The layers that they lack."""

    @contextmanager
    def _worker(self, libraries: frozenset[str], limits: Limits) -> Generator[Worker]:
        with open_worker(self.isolation, limits, without=self.without) as worker:
            yield worker


def attack_candidate(
    attack: CandidateAttack,
    level: Isolation,
    without: Collection[Layer] = (),
    executor: Executor | None = None,
) -> Finding:
    """Run all variants of an attack at one level; it succeeds if one of them does.

    Layers may be left out in an outer sandbox only.

    Args:
        executor: executor of the folds; None for this process
    """
    layers = layers_in_force(level, without)
    found = [
        conclude(
            attack,
            name,
            _observe(attack, name, level, without, executor=executor),
            layers,
            attack.success,
        )
        for name in attack.sources
    ]
    return worst_of(found, attack.number, str(level), tuple(str(layer) for layer in without))


def attack_unchecked(
    attack: CandidateAttack, level: Isolation, without: Collection[SuspicionKind]
) -> Iterator[SuspicionFinding]:
    """Each variant of an attack, with relations left out and with all; no layer is left out."""
    layers = layers_in_force(level, ())
    for name in attack.sources:
        seen, checked = (_observe(attack, name, level, (), off) for off in (without, ()))
        ended = conclude(attack, name, checked, layers, attack.success)
        yield SuspicionFinding(
            attack.number,
            name,
            str(level),
            tuple(map(str, without)),
            seen.honest,
            seen.value,
            attack.success(seen),
            replace(ended, level=str(level)),
        )


@cache
def honest_value(name: ProblemName, level: Isolation) -> float:
    """V of the honest candidate on which all attacks are built."""
    problem = small_problem(name)
    evaluator = problem.evaluator(Evaluator, level, _HONEST_SECONDS, _HONEST_MB)
    with targets(_HONEST_MB) as given:
        outcome = evaluator.evaluate(fill_in(HONEST, given.source, problem)).outcome
    if isinstance(outcome, Failure):
        raise AssertionError(f"the honest candidate failed: {outcome}")
    return outcome.value


def _observe(
    attack: CandidateAttack,
    name: str,
    level: Isolation,
    without: Collection[Layer],
    unchecked: Collection[SuspicionKind] = (),
    executor: Executor | None = None,
) -> Observed:
    problem, honest = small_problem(attack.problem), honest_value(attack.problem, level)
    kind = _EvaluatorWithoutLayers if without else Evaluator
    evaluator = problem.evaluator(
        kind,
        level,
        attack.limit,
        attack.memory_mb,
        attack.folds,
        _places(name in attack.at_once, executor),
        unchecked,
    )
    if isinstance(evaluator, _EvaluatorWithoutLayers):
        evaluator.without = without
    with targets(attack.memory_mb) as given:
        begin = time.monotonic()
        least = honest if attack.folds != 1 else 0.0
        evaluation = _evaluate_as_searches_do(
            evaluator, fill_in(attack.sources[name], given.source, problem), least
        )
        seconds = time.monotonic() - begin
        return _observed(evaluation, given, honest, seconds, attack.limit)


def _places(at_once: bool, executor: Executor | None) -> Executor:
    """Both folds at the same time, or one after the other."""
    if executor is None:
        return LocalExecutor(2 if at_once else 1)
    return executor if at_once else SequentialExecutor(executor)


def _evaluate_as_searches_do(evaluator: Evaluator, source: str, least: float) -> Evaluation:
    """Evaluate as a search does: a score below `least`, which would win, is checked."""
    evaluation = evaluator.evaluate(source)
    outcome = evaluation.outcome
    if isinstance(outcome, Score) and outcome.value < least:
        failure = evaluator.objection(source, evaluation.folds)
        return Evaluation(failure or outcome, evaluation.folds, evaluation.output)
    return evaluation


def _observed(
    evaluation: Evaluation, given: Targets, honest: float, seconds: float, limit: float
) -> Observed:
    outcome, output = evaluation.outcome, evaluation.output
    failed = isinstance(outcome, Failure)
    survivors = given.traces.survivors()
    return Observed(
        value=None if failed else outcome.value,
        honest=honest,
        reason=outcome.reason if failed else None,
        detail=outcome.detail if failed else "",
        output=output,
        steps=said_steps(output),
        seconds=seconds,
        limit=limit,
        overran=not failed or outcome.reason not in (Reason.FIT_TIMEOUT, Reason.SIMULATE_TIMEOUT),
        ran=given.ran,
        ledger=given.ledger_changed,
        leaked=given.secret in output,
        hurt=given.neighbour.hurt,
        survivors=survivors,
        strays=given.traces.strays(),
    )
