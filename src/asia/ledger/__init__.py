"""Append-only, hash-chained record of a search; all else is a view of it."""

from asia.ledger._chain import Chain, Line, in_use, read_lines
from asia.ledger._events import (
    Evaluated,
    Event,
    Extended,
    FoldRecord,
    Phase,
    Proposed,
    Refitted,
    RungScored,
    Started,
    Status,
    Stopped,
    TestRecord,
    Unsealed,
    Unsealing,
)
from asia.ledger._exports import (
    describe_result,
    error_value,
    journal,
    results_table,
    scores_told,
    write_exports,
)
from asia.ledger._store import Store
from asia.ledger._verify import Verified, check_lock, verify
from asia.ledger._view import Experiment, Run, SearchView, State, find_run, open_run, replay
from asia.scoring import Diagnostics

__all__ = [
    "Chain",
    "Diagnostics",
    "Evaluated",
    "Event",
    "Experiment",
    "Extended",
    "FoldRecord",
    "Line",
    "Phase",
    "Proposed",
    "Refitted",
    "Run",
    "RungScored",
    "SearchView",
    "Started",
    "State",
    "Status",
    "Stopped",
    "Store",
    "TestRecord",
    "Unsealed",
    "Unsealing",
    "Verified",
    "check_lock",
    "describe_result",
    "error_value",
    "find_run",
    "in_use",
    "journal",
    "open_run",
    "read_lines",
    "replay",
    "results_table",
    "scores_told",
    "verify",
    "write_exports",
]
