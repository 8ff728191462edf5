"""The loop: problem + agent + budget + ledger. Alone holds both an agent and an evaluator."""

from asia.search._agent_view import agent_view, problem_facts
from asia.search._dry_run import dry_run
from asia.search._environment import environment_changes
from asia.search._excerpts import simulated_excerpts
from asia.search._loop import OnEvent
from asia.search._replay import Replayed, ReplayReport, replay_run
from asia.search._run import (
    LOCK,
    Prepared,
    check_baseline,
    make_evaluator,
    prepare,
    search,
    with_early_stopping,
    with_relay_budget,
)
from asia.search._secrecy import check_hidden_from_workers
from asia.search._simulate import BandedSimulation, simulate, simulate_cases, simulate_members
from asia.search._sinks import OpenSink, Sink, Sinks, find_sink, open_sinks
from asia.search._steering import Steering
from asia.search._unseal import CONSENT, UnsealResult, needs_consent, unseal
from asia.search.ablation.ablate import OnFit, ablate
from asia.search.dossier import Dossier, validate
from asia.search.final.confirmation import OnRepeat, confirm
from asia.search.final.members import FinalMember, final_members, fold_models

__all__ = [
    "CONSENT",
    "LOCK",
    "BandedSimulation",
    "Dossier",
    "FinalMember",
    "OnEvent",
    "OnFit",
    "OnRepeat",
    "OpenSink",
    "Prepared",
    "ReplayReport",
    "Replayed",
    "Sink",
    "Sinks",
    "Steering",
    "UnsealResult",
    "ablate",
    "agent_view",
    "check_baseline",
    "check_hidden_from_workers",
    "confirm",
    "dry_run",
    "environment_changes",
    "final_members",
    "find_sink",
    "fold_models",
    "make_evaluator",
    "needs_consent",
    "open_sinks",
    "prepare",
    "problem_facts",
    "replay_run",
    "search",
    "simulate",
    "simulate_cases",
    "simulate_members",
    "simulated_excerpts",
    "unseal",
    "validate",
    "with_early_stopping",
    "with_relay_budget",
]
