"""Plan of a comparison: its searches and their budgets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from asia.agents import Agent
from asia.bench._paper import Paper
from asia.errors import UserError
from asia.problem import Budget
from asia.problem.load import Problem
from asia.protocol import EarlyStopping

QUICK_EXPERIMENTS = 3
_QUICK_SECONDS = 120.0
_REFERENCE_SECONDS = 900.0
# Arms are compared at equal budget: none may stop because it found nothing for a while.
_PATIENCE = 100_000

SETTINGS: tuple[EarlyStopping, ...] = ("inner", "validation")


@dataclass(frozen=True)
class Arm:
    """One agent in a comparison."""

    name: str
    """Name in `--arms` and in the names of its runs."""
    label: str
    """Name in tables and pictures."""
    make: Callable[[], Agent]
    """Makes the agent, a new one for each search."""
    fixed: int | None = None
    """Number of fixed candidates that it evaluates, and no more, only if early stopping sees the
    validation fold; None for an agent that searches.
    """
    settings: Mapping[str, str] = field(default_factory=dict[str, str], hash=False)
    """Recorded settings of the agent."""


@dataclass(frozen=True)
class ComparisonPlan:
    """Arms, settings and budget of a comparison."""

    problem: Problem
    """The problem that every arm searches a model for."""
    arms: tuple[Arm, ...]
    """The agents, each of them once."""
    seeds: tuple[int, ...]
    """Seeds; one search for each arm, setting and seed."""
    runs: Path
    """The directory of the runs."""
    settings: tuple[EarlyStopping, ...] = SETTINGS
    """Settings of early stopping, never two of them in one table."""
    experiments: int | None = None
    """Experiments of each search; None for the paper's number, else the problem's."""
    paper: Paper | None = None
    """The paper's figures; None for problems that it does not treat."""
    quick: bool = False
    """A few experiments with short fits, to see that everything works."""
    word: Literal["bench", "compare"] = "bench"
    """`compare`: agents against each other (`asia bench agents`), where no test is declared."""

    def __post_init__(self) -> None:
        for what, given in (
            ("arm", [a.name for a in self.arms]),
            ("seed", list(self.seeds)),
            ("early-stopping setting", list(self.settings)),
        ):
            if not given or len(set(given)) < len(given):
                text = ", ".join(str(g) for g in given) or "none"
                raise UserError(f"a comparison needs every {what} once, got: {text}")

    @property
    def name(self) -> str:
        """`bench-PROBLEM`, `compare-PROBLEM`: the directory of the results."""
        return f"{self.word}-{self.problem.name}" + ("-quick" if self.quick else "")

    @property
    def directory(self) -> Path:
        """Folder of tables and pictures."""
        return self.runs / self.name

    @property
    def budget(self) -> int:
        """Experiments of each search."""
        if self.experiments is not None:
            return self.experiments
        if self.quick:
            return QUICK_EXPERIMENTS
        return self.paper.experiments if self.paper else self.problem.budget.experiments

    @property
    def searches(self) -> tuple[PlannedRun, ...]:
        """Searches in order: the honest setting first, the expert before the controls."""
        return tuple(
            self._search(arm, setting, seed)
            for setting in self.settings
            for seed in self.seeds
            for arm in self.arms
            if arm.fixed is None or setting == "validation"
        )

    @property
    def candidate_for_test(self) -> str | None:
        """Name of the run whose test may be opened: the expert's with the first seed, in the
        honest setting where there is one. None without an expert and among agents compared."""
        if self.word == "compare":
            return None
        experts = (s for s in self.searches if s.arm.name == "expert")
        return next((s.name for s in experts), None)

    def _search(self, arm: Arm, setting: EarlyStopping, seed: int) -> PlannedRun:
        rule = replace(self.problem.protocol, early_stopping=setting)
        budget = self._budget(arm)
        problem = replace(self.problem, protocol=rule, budget=budget)
        return PlannedRun(f"{self.name}-{arm.name}-{setting}-s{seed}", arm, setting, seed, problem)

    def _budget(self, arm: Arm) -> Budget:
        budget = replace(self.problem.budget, experiments=self.budget, patience=_PATIENCE)
        if arm.fixed is not None:
            seconds = max(budget.fit_seconds, _REFERENCE_SECONDS)
            return replace(budget, experiments=1 + arm.fixed, fit_seconds=seconds)
        if self.quick:
            return replace(budget, fit_seconds=min(budget.fit_seconds, _QUICK_SECONDS))
        return budget


@dataclass(frozen=True)
class PlannedRun:
    """One search of a comparison."""

    name: str
    """Name of its run."""
    arm: Arm
    """Agent of the search."""
    setting: EarlyStopping
    """Its setting of early stopping."""
    seed: int
    """Its seed."""
    problem: Problem
    """The problem with the protocol and budget of this search."""


def select_arms(arms: Sequence[Arm], names: Sequence[str] | None) -> tuple[Arm, ...]:
    """The arms of these names, all when None. Raises UserError for an unknown name."""
    if names is None:
        return tuple(arms)
    known = {arm.name: arm for arm in arms}
    for name in names:
        if name not in known:
            raise UserError(f"no arm '{name}'; there is: {', '.join(known)}")
    return tuple(known[name] for name in names)
