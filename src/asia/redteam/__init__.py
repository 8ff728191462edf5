"""Scripted cheats that must fail, and honest candidates that must not be taken for cheats.

Shipped, so that everybody can try them on their own machine: `asia doctor --attack`.
"""

from asia.redteam._honest import problem_named
from asia.redteam._suite import (
    RedTeamPlan,
    RedTeamReport,
    each_layer,
    honest_plan,
    run_suite,
    without_checks,
    without_layers,
)
from asia.redteam._table import line, report_table, summary, unchecked_table, without_table
from asia.redteam._types import (
    Attack,
    AttackVerdict,
    Barrier,
    CandidateAttack,
    Finding,
    HonestFinding,
    SearchAttack,
    SuspicionFinding,
)
from asia.redteam.attacks.table import ATTACKS
from asia.redteam.outside.outer_sandbox import why_no_outer
from asia.redteam.outside.without_isolation import OFF

__all__ = [
    "ATTACKS",
    "OFF",
    "Attack",
    "AttackVerdict",
    "Barrier",
    "CandidateAttack",
    "Finding",
    "HonestFinding",
    "RedTeamPlan",
    "RedTeamReport",
    "SearchAttack",
    "SuspicionFinding",
    "each_layer",
    "honest_plan",
    "line",
    "problem_named",
    "report_table",
    "run_suite",
    "summary",
    "unchecked_table",
    "why_no_outer",
    "without_checks",
    "without_layers",
    "without_table",
]
