"""The two small problems that attacks are tried on, made from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.evaluation import Evaluator
from asia.executor import LocalExecutor
from asia.problem import Budget
from asia.protocol import FoldRule, ProtocolRule, make_folds
from asia.sandbox import Isolation

E = TypeVar("E", bound=Evaluator)
ProtocolKind = Literal["simulation", "windows"]
_INPUTS = (Signal("drive"), Signal("measured before"), Signal("sample"))
_RULES = {
    "simulation": ProtocolRule("simulation", FoldRule(count=2), 4, 4),
    "windows": ProtocolRule("windows", FoldRule(count=2), 1, 1, horizon=8),
}


@dataclass(frozen=True)
class SmallProblem:
    """A first-order lag whose second half is driven harder and saturates.

    Inputs: the drive; the output measured one sample before, as a logger records a feedback signal,
    which shows the next output to a candidate that looks ahead; the number of the sample.
    """

    kind: ProtocolKind
    """Whether the whole record is simulated or windows of it."""
    record: Trajectory
    """The training record."""
    rule: ProtocolRule
    """How candidates are scored."""

    @property
    def crude(self) -> tuple[float, float]:
        """Pole and gain of an honest model that leaves something to gain."""
        return (0.93, 0.1) if self.kind == "windows" else (0.7, 0.28)

    @property
    def context(self) -> Context:
        """The context that candidates receive."""
        rule = self.rule
        past = rule.past_inputs, rule.past_outputs
        return Context(_INPUTS, (Signal("level"),), 1.0, *past, rule.horizon, seed=7)

    def evaluator(
        self,
        kind: type[E],
        level: Isolation,
        seconds: float,
        memory_mb: int,
        folds: int = 2,
        at_once: int = 1,
    ) -> E:
        """The real one, or one of its kind, one fold after the other unless more are `at_once`."""
        return kind(
            make_folds([self.record], self.rule)[:folds],
            [self.record],
            self.context,
            self.rule,
            Budget(1, seconds, memory_mb),
            level,
            LocalExecutor(at_once),
        )


def small_problem(kind: ProtocolKind) -> SmallProblem:
    """The same numbers each time."""
    rng = np.random.default_rng(5)
    slow = kind == "windows"
    pole, gain = (0.95, 0.05) if slow else (0.75, 0.25)
    drive = np.repeat(rng.normal(size=12), 10)
    drive[60:] *= 2
    y = np.zeros(120)
    for k in range(1, 120):
        y[k] = pole * y[k - 1] + gain * 2 * np.tanh(drive[k - 1])
    y += (0.002 if slow else 0.02) * rng.normal(size=120)
    before = np.concatenate([[0.0], y[:-1]])
    u = np.stack([drive, before, np.arange(120.0)], axis=1)
    return SmallProblem(kind, Trajectory(u, y, 1.0, "record"), _RULES[kind])
