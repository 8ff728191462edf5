"""The loop: problem + agent + budget + ledger. Alone holds both an agent and an evaluator."""

from asia.search._agent_view import agent_view, problem_facts
from asia.search._search import LOCK, Prepared, check_baseline, prepare, search, with_early_stopping
from asia.search._simulate import simulate
from asia.search._unseal import UnsealResult, unseal

__all__ = [
    "LOCK",
    "Prepared",
    "UnsealResult",
    "agent_view",
    "check_baseline",
    "prepare",
    "problem_facts",
    "search",
    "simulate",
    "unseal",
    "with_early_stopping",
]
