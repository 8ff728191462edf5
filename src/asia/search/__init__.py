"""The loop: problem + agent + budget + ledger. Alone holds both an agent and an evaluator."""

from asia.search._agent_view import agent_view, problem_facts
from asia.search._controls import Controls
from asia.search._desk import Desk, Job, Order, Result, RunDesk, Standing, start_search, wait
from asia.search._search import LOCK, Prepared, check_baseline, prepare, search, with_early_stopping
from asia.search._serve import prepare_order
from asia.search._simulate import simulate
from asia.search._unseal import UnsealResult, unseal
from asia.search._workspace import CANDIDATE, Workspace, make_workspace

__all__ = [
    "CANDIDATE",
    "LOCK",
    "Controls",
    "Desk",
    "Job",
    "Order",
    "Prepared",
    "Result",
    "RunDesk",
    "Standing",
    "UnsealResult",
    "Workspace",
    "agent_view",
    "check_baseline",
    "make_workspace",
    "prepare",
    "prepare_order",
    "problem_facts",
    "search",
    "simulate",
    "start_search",
    "unseal",
    "wait",
    "with_early_stopping",
]
