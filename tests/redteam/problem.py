"""The small problems that attacks are tried on, made from a seed."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal, TypeAlias

import numpy as np

from asia.candidate import Context
from asia.data.standardise import standardised
from asia.data.trajectory import Array, Signal, Trajectory
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import Executor, LocalExecutor
from asia.judge.sandbox.types import Isolation
from asia.problem.budget import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import FoldRule, Group, ProtocolRule

ProblemName = Literal[
    "simulation",
    "windows",
    "weather",
    "machines",
    "pulses",
    "drift",
    "levels",
    "noisy",
    "noisy windows",
    "counted",
]


class Principle(StrEnum):
    """Rule of the evaluation that leaves a kind of cheat nothing to use."""

    FOLD_STATISTICS = "fold statistics"
    """Mean and standard deviation by which signals are standardised are those of a fit's own
    training records."""


Check: TypeAlias = SuspicionKind | Principle
"""Relation or principle that can be left out, to show what it stops."""

_INPUTS = (Signal("drive"), Signal("measured before"), Signal("sample"))
# Pole and gain of an honest model of the fleet, of the drifting record, of the record of two levels
# when it is standardised, and of the noisy one.
_FLEET, _DRIFT, _LEVELS, _NOISY = (0.95, 0.1), (0.99, 0.1), (0.9, 0.2), (0.75, 0.25)
_RECORDS = 10
_DAYS = FoldRule(
    "leave_one_group_out",
    groups=tuple(
        Group(day, tuple(f"machine {n}" for n in range(first, _RECORDS, 2)))
        for first, day in enumerate(("first day", "second day"))
    ),
)


@dataclass(frozen=True)
class SmallProblem:
    """First-order lags, with three inputs: the drive; the output measured one sample before, as a
    logger records a feedback signal, which shows the next output to a candidate that looks ahead;
    the number of the sample.
    """

    records: tuple[Trajectory, ...]
    rule: ProtocolRule
    crude: tuple[float, float]
    """Pole and gain of an honest model that leaves something to gain."""
    standardised: bool = False
    """Whether fits standardise their records."""
    guard: tuple[Trajectory, ...] = ()
    """Records that no candidate sees."""

    @property
    def record(self) -> Trajectory:
        """The first of its records."""
        return self.records[0]

    @property
    def context(self) -> Context:
        """The context that candidates receive."""
        rule = self.rule
        past = rule.past_inputs, rule.past_outputs
        known = Context(_INPUTS, (Signal("level"),), 1.0, *past, rule.horizon, seed=7)
        return replace(known, detrend=self.standardised, scale=self.standardised)

    @property
    def by_whole_records(self) -> SmallProblem:
        """The same without the principle: standardised before the folds are cut."""
        records, *_ = standardised(list(self.records), self.context)
        return replace(self, records=tuple(records), standardised=False)

    def evaluator(
        self,
        kind: type[WorkerRunner],
        level: Isolation,
        seconds: float,
        memory_mb: int,
        folds: int | None = None,
        executor: Executor | None = None,
        without: Collection[Check] = (),
    ) -> Evaluator:
        """The real one, with a runner of this kind.

        Args:
            executor: where folds run; None for one after the other, here
            without: relations that it does not check
        """
        relations = [one for one in without if isinstance(one, SuspicionKind)]
        chosen = make_folds(self.records, self.rule)[:folds]
        data = EvaluationData(chosen, self.records, self.context, self.rule)
        workers = kind(level, Budget(1, seconds, memory_mb), executor or LocalExecutor(1))
        return Evaluator(data, workers, EvaluatorOptions(without=relations))


def _saturating(seed: int, slow: bool) -> Trajectory:
    """A record whose second half is driven harder and saturates."""
    rng = np.random.default_rng(5 + seed)
    pole, gain = (0.95, 0.05) if slow else (0.75, 0.25)
    drive = np.repeat(rng.normal(size=12), 10)
    drive[60:] *= 2
    y = np.zeros(120)
    for k in range(1, 120):
        y[k] = pole * y[k - 1] + gain * 2 * np.tanh(drive[k - 1])
    y += (0.002 if slow else 0.02) * rng.normal(size=120)
    before = np.concatenate([[0.0], y[:-1]])
    u = np.stack([drive, before, np.arange(120.0)], axis=1)
    return Trajectory(u, y, 1.0, "record")


def _fleet(seed: int, weather: float, own: float, samples: int = 102) -> tuple[Trajectory, ...]:
    """Records of like machines. A disturbance that turns once pushes all of them, as weather does,
    and each has a push of its own. A window's past is too noisy to show either. No feedback signal
    is recorded."""
    rng = np.random.default_rng(8 + seed)
    pole, gain = _FLEET
    turning = np.where(np.arange(samples) < samples // 2 + 1, weather, -weather)
    found: list[Trajectory] = []
    for number in range(_RECORDS):
        drive = np.repeat(rng.normal(size=17), 6)[:samples]
        pushed = gain * drive + turning + own * (-1) ** number
        y = _lag(pole, pushed, rng.normal()) + 0.1 * rng.normal(size=samples)
        u = np.stack([drive, rng.normal(size=samples), np.arange(float(samples))], axis=1)
        found.append(Trajectory(u, y, 1.0, f"machine {number}"))
    return tuple(found)


def _drifting(seed: int) -> Trajectory:
    """A record that wanders off from any simulation, and shows again where it went in the part
    that trains after the held-out one. No feedback signal is recorded."""
    rng = np.random.default_rng(4 + seed)
    samples, pole, gain = 162, *_DRIFT
    drive = np.repeat(rng.normal(size=18), 9)
    y = _lag(pole, gain * drive + 0.15 * rng.normal(size=samples), 0.0)
    u = np.stack([drive, rng.normal(size=samples), np.arange(float(samples))], axis=1)
    return Trajectory(u, y, 1.0, "record")


def _two_levels(seed: int) -> Trajectory:
    """A record whose second half has another level and answers more to the drive. No feedback
    signal is recorded."""
    rng = np.random.default_rng(seed)
    samples, pole, level = 242, _LEVELS[0], 0.4
    drive = np.repeat(rng.normal(size=samples // 6 + 2), 6)[:samples]
    first = np.arange(samples) <= samples // 2
    pushed = np.where(first, 0.08, 0.3) * drive + (1 - pole) * np.where(first, level, -level)
    y = _lag(pole, pushed, level) + 0.02 * rng.normal(size=samples)
    u = np.stack([drive, rng.normal(size=samples), np.arange(float(samples))], axis=1)
    return Trajectory(u, y, 1.0, "record")


def _noisy(seed: int, samples: int = 480) -> Trajectory:
    """A record whose noise nothing tells before the sample after it, which carries it."""
    rng = np.random.default_rng(6 + seed)
    drive = np.repeat(rng.normal(size=samples // 6), 6)
    y = _lag(_NOISY[0], _NOISY[1] * drive, 0.0) + 0.2 * rng.normal(size=samples)
    before = np.concatenate([[0.0], y[:-1]])
    u = np.stack([drive, before, np.arange(float(samples))], axis=1)
    return Trajectory(u, y, 1.0, "record")


def _counted(seed: int) -> Trajectory:
    """The first 200 samples of a record of a saturating plant with a slow disturbance, or, for a
    seed other than 0, the 60 after them. No feedback signal is recorded."""
    rng = np.random.default_rng(1)
    drive = 1.5 * np.repeat(rng.normal(size=52), 5)
    slow = _lag(0.9, 0.05 * rng.normal(size=260), 0.0)
    slow += 0.3 * np.sin(2 * np.pi * np.arange(260.0) / 500)
    y = _lag(_NOISY[0], 2 * _NOISY[1] * np.tanh(drive), 0.0) + slow
    y += 0.04 * rng.normal(size=260)
    u = np.stack([drive, rng.normal(size=260), np.arange(260.0)], axis=1)
    part = slice(200, 260) if seed else slice(200)
    return Trajectory(u[part], y[part], 1.0, "later" if seed else "record")


def _lag(pole: float, pushed: Array, start: float) -> Array:
    """The first-order lag's outputs, each pushed by the sample before."""
    y = np.full(len(pushed), start)
    for k in range(1, len(y)):
        y[k] = pole * y[k - 1] + pushed[k - 1]
    return y


_Row = tuple[ProtocolRule, tuple[float, float], Callable[[int], tuple[Trajectory, ...]]]
_TWO_FOLDS = FoldRule(count=2)
_PROBLEMS: dict[ProblemName, _Row] = {
    "simulation": (
        ProtocolRule("simulation", _TWO_FOLDS, 4, 4),
        (0.7, 0.28),
        lambda seed: (_saturating(seed, slow=False),),
    ),
    "windows": (
        ProtocolRule("windows", _TWO_FOLDS, 1, 1, horizon=8),
        (0.93, 0.1),
        lambda seed: (_saturating(seed, slow=True),),
    ),
    "noisy": (ProtocolRule("simulation", _TWO_FOLDS, 4, 4), _NOISY, lambda seed: (_noisy(seed),)),
    "noisy windows": (
        ProtocolRule("windows", _TWO_FOLDS, 1, 1, horizon=24),
        _NOISY,
        lambda seed: (_noisy(seed),),
    ),
    "counted": (
        ProtocolRule("simulation", _TWO_FOLDS, 4, 4),
        _NOISY,
        lambda seed: (_counted(seed),),
    ),
    "weather": (
        ProtocolRule("windows", _TWO_FOLDS, 2, 2, horizon=10),
        _FLEET,
        lambda seed: _fleet(seed, weather=0.1, own=0.0),
    ),
    "machines": (
        ProtocolRule("windows", _TWO_FOLDS, 2, 2, horizon=10),
        _FLEET,
        lambda seed: _fleet(seed, weather=0.0, own=0.1),
    ),
    "pulses": (
        ProtocolRule("windows", _DAYS, 2, 2, horizon=10),
        _FLEET,
        lambda seed: _fleet(seed, weather=0.0, own=0.1, samples=12),
    ),
    "drift": (
        ProtocolRule("simulation", FoldRule(count=4), 2, 2),
        _DRIFT,
        lambda seed: (_drifting(seed),),
    ),
    "levels": (
        ProtocolRule("simulation", _TWO_FOLDS, 2, 2),
        _LEVELS,
        lambda seed: (_two_levels(seed),),
    ),
}


def small_problem(name: ProblemName) -> SmallProblem:
    """The same numbers each time."""
    rule, crude, make = _PROBLEMS[name]
    standardised = name == "levels"
    return SmallProblem(make(0), rule, crude, standardised=standardised, guard=make(1)[:1])
