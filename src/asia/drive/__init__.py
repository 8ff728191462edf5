"""Drivers from outside: a desk where candidates are handed in, and who hands them in."""

from asia.drive._answers import DryRunSummary, ExperimentSummary, SearchProgress, Submission
from asia.drive._desk import Desk, RunDesk, wait
from asia.drive._detached import SearchRequest, start_search
from asia.drive._dry_run_words import dry_run_lines
from asia.drive._ending import end_idle
from asia.drive._evidence import EvidenceSummary, FoldSummary
from asia.drive._program import Confinement
from asia.drive._serve import prepare_request
from asia.drive._workspace import CANDIDATE, Workspace, is_workspace, make_workspace

__all__ = [
    "CANDIDATE",
    "Confinement",
    "Desk",
    "DryRunSummary",
    "EvidenceSummary",
    "ExperimentSummary",
    "FoldSummary",
    "RunDesk",
    "SearchProgress",
    "SearchRequest",
    "Submission",
    "Workspace",
    "dry_run_lines",
    "end_idle",
    "is_workspace",
    "make_workspace",
    "prepare_request",
    "start_search",
    "wait",
]
