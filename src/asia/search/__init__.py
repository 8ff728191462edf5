"""The loop: problem + agent + budget + ledger. Alone holds both an agent and an evaluator."""

from asia.search._agent_view import agent_view, problem_facts
from asia.search._command import run_command
from asia.search._command_rules import CommandRules, check_rules
from asia.search._controls import Controls
from asia.search._desk import Desk, Job, Result, RunDesk, Standing, wait
from asia.search._detached import Order, start_search
from asia.search._hidden import check_outside
from asia.search._loop import OnEvent
from asia.search._replay import Replayed, ReplayReport, replay_run
from asia.search._search import LOCK, Prepared, check_baseline, prepare, search, with_early_stopping
from asia.search._serve import prepare_order
from asia.search._simulate import simulate
from asia.search._unseal import CONSENT, UnsealResult, needs_consent, unseal
from asia.search._workspace import CANDIDATE, Workspace, make_workspace

__all__ = [
    "CANDIDATE",
    "CONSENT",
    "LOCK",
    "CommandRules",
    "Controls",
    "Desk",
    "Job",
    "OnEvent",
    "Order",
    "Prepared",
    "ReplayReport",
    "Replayed",
    "Result",
    "RunDesk",
    "Standing",
    "UnsealResult",
    "Workspace",
    "agent_view",
    "check_baseline",
    "check_outside",
    "check_rules",
    "make_workspace",
    "needs_consent",
    "prepare",
    "prepare_order",
    "problem_facts",
    "replay_run",
    "run_command",
    "search",
    "simulate",
    "start_search",
    "unseal",
    "wait",
    "with_early_stopping",
]
