"""The paper's comparisons, rerun: expert against random search, under each early-stopping setting.

Every search is a run of its own, so a comparison that was interrupted goes on where it was.
"""

from asia.bench._arms import ARM_NAMES, arms
from asia.bench._bench import Result, Watcher, bench
from asia.bench._json import result_object
from asia.bench._paper import Paper, paper
from asia.bench._plan import QUICK_EXPERIMENTS, SETTINGS, Arm, Plan, PlannedRun, chosen
from asia.bench._references import FixedAgent, reference_agent
from asia.bench._rows import Comparison, Reached, Row
from asia.bench._tables import Table

__all__ = [
    "ARM_NAMES",
    "QUICK_EXPERIMENTS",
    "SETTINGS",
    "Arm",
    "Comparison",
    "FixedAgent",
    "Paper",
    "Plan",
    "PlannedRun",
    "Reached",
    "Result",
    "Row",
    "Table",
    "Watcher",
    "arms",
    "bench",
    "chosen",
    "paper",
    "reference_agent",
    "result_object",
]
