"""The paper's comparisons, rerun: expert against random search, under each early-stopping setting.

Every search is a run of its own, so a comparison that was interrupted goes on where it was.
"""

from asia.bench._arms import ARM_NAMES, make_arms
from asia.bench._bench import BenchResult, Watcher, bench
from asia.bench._json import result_object
from asia.bench._paper import Paper, paper
from asia.bench._plan import (
    QUICK_EXPERIMENTS,
    SETTINGS,
    Arm,
    ComparisonPlan,
    PlannedRun,
    select_arms,
)
from asia.bench._references import FixedAgent, reference_agent
from asia.bench._rows import Comparison, Reached, Row
from asia.bench._tables import TextTable

__all__ = [
    "ARM_NAMES",
    "QUICK_EXPERIMENTS",
    "SETTINGS",
    "Arm",
    "BenchResult",
    "Comparison",
    "ComparisonPlan",
    "FixedAgent",
    "Paper",
    "PlannedRun",
    "Reached",
    "Row",
    "TextTable",
    "Watcher",
    "bench",
    "make_arms",
    "paper",
    "reference_agent",
    "result_object",
    "select_arms",
]
