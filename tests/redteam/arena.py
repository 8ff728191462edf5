"""Arena: one cheating candidate against the real evaluator."""

import time
from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

from asia.errors import CandidateError, Reason
from asia.judge.evaluation.evaluator import Evaluation, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import Executor, LocalExecutor, SequentialExecutor
from asia.judge.sandbox.availability import layers_in_force, open_worker
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.worker import Worker
from asia.judge.scoring.confirmation import (
    ComparedParts,
    Confirmation,
    paired_gain,
    share_gained,
)
from asia.judge.scoring.outcome import Failure, Score
from asia.problem.folds import whole
from asia.search.guard import simulated
from tests.redteam.attacks.source import HONEST, fill_in
from tests.redteam.evidence import conclude, said_steps, targets, worst_of
from tests.redteam.problem import Check, Principle, ProblemName, SmallProblem, small_problem
from tests.redteam.types import CandidateAttack, Finding, Observed, SuspicionFinding

# Evaluation of one cheating candidate with the real evaluator, and detection of its traces.


class _RunnerWithoutLayers(WorkerRunner):
    """Runner whose workers lack some layers; for an outer sandbox only."""

    without: Collection[Layer] = ()
    """The layers that they lack."""

    @contextmanager
    def open(self, libraries: frozenset[str], limits: Limits) -> Generator[Worker]:
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
    found: list[Finding] = []
    for name in attack.sources:
        seen = _observe(attack, name, level, without, executor=executor)
        found.append(conclude(attack, name, seen, layers, attack.success))
    return worst_of(found, attack.number, str(level), tuple(str(layer) for layer in without))


def attack_unchecked(
    attack: CandidateAttack, level: Isolation, without: Collection[Check]
) -> Iterator[SuspicionFinding]:
    """Each variant of an attack, with checks left out and with all; no layer is left out."""
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
def honest_value(name: ProblemName, level: Isolation, *, whole: bool = False) -> float:
    """V of the honest candidate on which all attacks are built.

    Args:
        whole: whether whole records are standardised
    """
    problem = small_problem(name).by_whole_records if whole else small_problem(name)
    evaluator = problem.evaluator(WorkerRunner, level, seconds=60.0, memory_mb=2048)
    with targets(2048) as given:
        outcome = evaluator.evaluate(fill_in(HONEST, given.source, problem)).outcome
    if isinstance(outcome, Failure):
        raise AssertionError(f"the honest candidate failed: {outcome}")
    return outcome.value


def _observe(
    attack: CandidateAttack,
    name: str,
    level: Isolation,
    without: Collection[Layer],
    unchecked: Collection[Check] = (),
    executor: Executor | None = None,
) -> Observed:
    whole = Principle.FOLD_STATISTICS in unchecked
    problem = small_problem(attack.problem)
    problem = problem.by_whole_records if whole else problem
    honest = honest_value(attack.problem, level, whole=whole)
    # Both folds at the same time, or one after the other.
    at_once = name in attack.at_once
    if executor is None:
        executor = LocalExecutor(2 if at_once else 1)
    elif not at_once:
        executor = SequentialExecutor(executor)
    evaluator = problem.evaluator(
        _RunnerWithoutLayers if without else WorkerRunner,
        level,
        attack.limit,
        attack.memory_mb,
        attack.folds,
        executor,
        unchecked,
    )
    if isinstance(evaluator.workers, _RunnerWithoutLayers):
        evaluator.workers.without = without
    with targets(attack.memory_mb) as given:
        source = fill_in(attack.sources[name], given.source, problem)
        begin = time.monotonic()
        evaluation = evaluator.evaluate(source)
        outcome, output = evaluation.outcome, evaluation.output
        # As in a search, a score that would win is checked.
        least = honest if attack.folds != 1 else 0.0
        if isinstance(outcome, Score) and outcome.value < least:
            outcome = evaluator.objection(source, evaluation) or outcome
        unconfirmed = ""
        if isinstance(outcome, Score) and outcome.value < least and not unchecked:
            plain = fill_in(HONEST, given.source, problem)
            unconfirmed = _unconfirmed(evaluator, problem, plain, source, evaluation)
        seconds = time.monotonic() - begin
        failed = isinstance(outcome, Failure)
        timeouts = (Reason.FIT_TIMEOUT, Reason.SIMULATE_TIMEOUT)
        survivors = given.traces.survivors()
        return Observed(
            value=None if failed else outcome.value,
            honest=honest,
            reason=outcome.reason if failed else None,
            detail=outcome.detail if failed else "",
            output=output,
            steps=said_steps(output),
            unconfirmed=unconfirmed,
            seconds=seconds,
            limit=attack.limit,
            overran=not failed or outcome.reason not in timeouts,
            ran=given.ran,
            ledger=given.ledger_changed,
            leaked=given.secret in output,
            hurt=given.neighbour.hurt,
            survivors=survivors,
            strays=given.traces.strays(),
        )


def _unconfirmed(
    evaluator: Evaluator, problem: SmallProblem, honest: str, source: str, found: Evaluation
) -> str:
    """Describe the gain over the honest candidate, if the guard records show less than half of it;
    "" if they confirm it."""
    blocks = tuple(whole(problem.guard, problem.rule))
    before = evaluator.evaluate(honest)
    assert isinstance(before.outcome, Score)
    assert isinstance(found.outcome, Score)
    gain = share_gained(before.outcome.value, found.outcome.value)
    try:
        y_hats = [
            simulated(evaluator, text, [each.artifacts.get(f.model) for f in each.folds], blocks)
            for text, each in ((honest, before), (source, found))
        ]
    except CandidateError as error:
        return f"unconfirmed: {error.reason.value}"
    data = evaluator.data
    guard = paired_gain(
        [ComparedParts([b.y for b in blocks], *y_hats, data.scale)], data.rule.metric
    )
    confirmed = Confirmation(1, gain, guard).confirmed
    return "" if confirmed else f"unconfirmed: gain {gain:.2g}, on the guard {guard.value:.2g}"


# Early end of work in other threads.


class Interruption:
    """Flag that ends the run and its workers."""

    def __init__(self) -> None:
        self.begun = False
        self._workers: set[Worker] = set()

    def begin(self) -> None:
        """End the workers that run, and those that start later."""
        self.begun = True
        for worker in list(self._workers):
            worker.abort()

    @contextmanager
    def ends(self, worker: Worker) -> Generator[None]:
        """While this is open, the worker is ended with the run."""
        self._workers.add(worker)
        try:
            if self.begun:
                worker.abort()
            yield
        finally:
            self._workers.discard(worker)
