"""Runs whose outcomes are made up: real ledgers and artifacts, figures that no model ever gave."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from asia.data import Array, Signal, Trajectory
from asia.data.sources import Source
from asia.data.sources.official import OfficialBenchmark
from asia.data.sources.simulated.source import Simulated
from asia.errors import Reason
from asia.judge.scoring.outcome import Failure, Score, combine, score_fold, score_test
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import (
    Evaluated,
    GuardLooked,
    GuardScore,
    Proposed,
    ReferenceScored,
    Started,
    Stopped,
    TestedModel,
    Unsealed,
)
from asia.problem import Budget
from asia.problem.folds import Fold, make_folds
from asia.problem.problem import Problem, TestSource
from asia.problem.protocol import ProtocolRule, TestRule

Outcomes = Sequence[tuple[str, float | None]]


SIMULATED = Simulated(0)


@dataclass(frozen=True)
class Shape:
    """Size of a made-up problem."""

    samples: tuple[int, ...] = (300,)
    inputs: tuple[Signal, ...] = (Signal("pump_voltage", "V"),)
    outputs: tuple[Signal, ...] = (Signal("tank2_level", "V"),)
    sampling_time: float = 4.0
    skip: int = 20
    name: str = "made_up"
    data: Source = SIMULATED


BENCHMARK = Shape(name="cascaded_tanks", data=OfficialBenchmark("benchmark:cascaded_tanks"))


def make_record(shape: Shape, samples: int, seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 6, (samples // 15 + 1, len(shape.inputs))), 15, axis=0)[:samples]
    y = np.zeros((samples, len(shape.outputs)))
    gain = rng.uniform(0.5, 1.5, (len(shape.inputs), len(shape.outputs)))
    for t in range(1, samples):
        y[t] = 0.95 * y[t - 1] + 0.05 * u[t - 1] @ gain
    y += 0.05 * rng.standard_normal(y.shape)
    return Trajectory(u, y, shape.sampling_time, f"record{seed}")


def make_problem(shape: Shape) -> Problem:
    train = tuple(make_record(shape, n, i) for i, n in enumerate(shape.samples))
    rule = ProtocolRule(past_inputs=5, past_outputs=5, test=TestRule(skip=shape.skip))
    return Problem(
        name=shape.name,
        description="",
        sampling_time=shape.sampling_time,
        inputs=shape.inputs,
        outputs=shape.outputs,
        train=train,
        data=shape.data,
        test=TestSource(None),
        protocol=rule,
        budget=Budget(),
    )


def wobble(y: Array, size: float, seed: int = 0) -> Array:
    """An imperfect simulation of `y`: slow errors of about `size` standard deviations."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.standard_normal(y.shape), axis=0)
    slow -= slow.mean(axis=0)
    return y + size * y.std(axis=0) * slow / slow.std(axis=0)


def write_run(
    directory: Path,
    problem: Problem,
    outcomes: Outcomes,
    references: Sequence[tuple[str, float]] = (("linear model", 0.345), ("last output held", 1.21)),
    unsealed: int = 0,
    guard: Sequence[tuple[int, float]] = (),
    parameters: Sequence[tuple[tuple[str, float], ...]] = (),
) -> Path:
    """A run directory. outcomes: title and V of each experiment, None for a failure; V is not what
    the artifacts would score. unsealed: number of test trajectories, 0 leaves the test sealed.
    guard: experiments and what they score there. parameters: names and values of each fold model,
    the same in all experiments."""
    folds = make_folds(problem.train, problem.protocol)
    store = Store(directory / "artifacts")
    best = float("inf")
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(_started(directory, problem, len(outcomes)))
        for name, value in references:
            chain.append(ReferenceScored(name, _score(folds, problem, value)[0]))
        for i, (title, value) in enumerate(outcomes, start=1):
            best = append_experiment(chain, store, problem, i, title, value, best, parameters)
        chain.append(Stopped("budget"))
        if guard:
            scores = [GuardScore(n, _score(folds, problem, value)[0]) for n, value in guard]
            chain.append(GuardLooked(1, tuple(scores), guard[-1][0]))
        if unsealed:
            chain.append(_opened(store, problem, unsealed))
    return directory


def append_experiment(
    chain: Chain,
    store: Store,
    problem: Problem,
    number: int,
    title: str,
    value: float | None,
    best: float,
    parameters: Sequence[tuple[tuple[str, float], ...]] = (),
    candidate: str = "",
) -> float:
    """An experiment with its result; V of the best one with it."""
    source = store.put((candidate or f"# {title}\n").encode())
    words = ("because", "lower")
    chain.append(Proposed(number, None, "explore", "family", title, *words, source, str(number)))
    if value is None:
        failure = Failure(Reason.NOT_FINITE, "", 1)
        chain.append(Evaluated(number, "invalid", failure, None, 1.0))
        return best
    outcome, arrays = _score(make_folds(problem.train, problem.protocol), problem, value)
    records = [
        replace(
            one, model=store.put(b"model"), y_hat=store.put_arrays(a), curve=store.put(b""),
            fit_seconds=1.0,
        )
        for one, a in zip(outcome.folds, arrays, strict=True)
    ]  # fmt: skip
    if parameters:
        records = [
            replace(one, errors=(value,), train_errors=(value,), parameters=own).stored(store)
            for one, own in zip(records, parameters, strict=True)
        ]
    status = "keep" if value < best else "discard"
    scored = Score(outcome.value, tuple(records))
    chain.append(Evaluated(number, status, scored, None, 1.0))
    return min(best, value)


def append_test(directory: Path, problem: Problem, trajectories: int) -> None:
    """The opening of the test of a run that is there."""
    with Chain(directory / "ledger.jsonl") as chain:
        chain.append(_opened(Store(directory / "artifacts"), problem, trajectories))


def _started(directory: Path, problem: Problem, experiments: int) -> Started:
    lock = directory / "problem.lock.toml"
    digest = hashlib.sha256(lock.read_bytes()).hexdigest() if lock.exists() else ""
    return Started(
        run=directory.name,
        problem=problem.name,
        agent="expert",
        seed=0,
        experiments=experiments,
        hours=None,
        outputs=tuple(s.name for s in problem.outputs),
        lock_digest=digest,
        protocol_digest="",
        test_digest="t",
        isolation="namespace",
        isolation_notes=(),
        environment={},
    )


def _score(folds: Sequence[Fold], problem: Problem, value: float):
    metric = problem.protocol.metric
    arrays = [[wobble(b.y, min(value, 2.0), f.index) for b in f.held_out] for f in folds]
    scores = [
        score_fold([b.y for b in f.held_out], a, f.scale, metric)
        for f, a in zip(folds, arrays, strict=True)
    ]
    combined = combine(scores)
    return type(combined)(value, combined.folds), arrays


def _opened(store: Store, problem: Problem, trajectories: int) -> Unsealed:
    shape = Shape(inputs=problem.inputs, outputs=problem.outputs)
    past, rule = problem.protocol.past, problem.protocol.test
    horizon = problem.protocol.horizon
    samples = past + 240 // (horizon or 1) * (horizon or 1)
    measured = [make_record(shape, samples, 100 + i).y[past:] for i in range(trajectories)]
    ensemble = [wobble(y, 0.2, 1) for y in measured]
    refit = [wobble(y, 0.25, 2) for y in measured]

    def record(y_hat: list[Array]) -> TestedModel:
        scores = (score_test(measured, y_hat, rule.metrics[0], rule.skip),)
        return TestedModel(scores, store.put_arrays(y_hat))

    return Unsealed(
        experiment=1,
        test_digest="t",
        channels=tuple(s.name for s in problem.outputs),
        trajectories=tuple(f"test{i + 1}" for i in range(trajectories)),
        lengths=tuple(len(y) for y in measured),
        skip=rule.skip,
        measured=store.put_arrays(measured),
        ensemble=record(ensemble),
        refit=record(refit),
        horizon=horizon,
    )
