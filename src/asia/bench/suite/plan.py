"""Plan of a suite: its benchmarks and their budgets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from asia._nearest import suggestion
from asia.agents import make_agent
from asia.bench._plan import Arm, ComparisonPlan
from asia.errors import UserError
from asia.problem.load import load_problem

SUITE = (
    "cascaded_tanks",
    "ced",
    "emps",
    "bouc_wen",
    "silverbox",
    "wiener_hammerstein",
    "nanodrone",
    "fine_steering_mirror",
    "f16",
    "parallel_wiener_hammerstein",
)
"""The benchmarks, small ones first."""


@dataclass(frozen=True)
class SuitePlan:
    """Plan with one search of the expert for each benchmark, with seed 0."""

    names: tuple[str, ...]
    """The benchmarks, in this order."""
    runs: Path
    """The directory of the runs."""
    experiments: int | None = None
    """Experiments of each search; None for each problem's own number."""

    @property
    def directory(self) -> Path:
        """Folder of the table and the picture."""
        return self.runs / "bench-suite"

    def comparison(self, name: str) -> ComparisonPlan:
        """The search of one benchmark, as `asia bench paper NAME` names it. Raises UserError when
        its data are not on this machine."""
        return ComparisonPlan(
            problem=load_problem(name),
            arms=(Arm("expert", "expert", partial(make_agent, "expert")),),
            seeds=(0,),
            runs=self.runs,
            settings=("inner",),
            experiments=self.experiments,
        )


def select_problems(only: str | None) -> tuple[str, ...]:
    """The benchmarks that `only` names, separated by commas, in the order of the suite; all when
    None. Raises UserError for a name that is not of the suite."""
    if only is None:
        return SUITE
    expected = [name.strip().replace("-", "_") for name in only.split(",") if name.strip()]
    for name in expected:
        if name not in SUITE:
            raise UserError(
                f"--only: there is no benchmark '{name}' in the suite{suggestion(name, SUITE)} "
                f"(they are {', '.join(SUITE)})"
            )
    if not expected:
        raise UserError(f"--only names no benchmark: expected some of {', '.join(SUITE)}")
    return tuple(name for name in SUITE if name in expected)
