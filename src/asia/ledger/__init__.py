"""Append-only, hash-chained record of a search; all else is a view of it."""

from asia.ledger._chain import Chain, in_use, read_lines
from asia.ledger._control import Control, control, control_words
from asia.ledger._disk import write_whole
from asia.ledger._events import (
    RESUMABLE,
    Again,
    Evaluated,
    Event,
    Exchanged,
    Extended,
    FoldEvidence,
    GuardLooked,
    GuardScore,
    Phase,
    Proposed,
    Refitted,
    Resumed,
    RungScored,
    SessionEnded,
    SessionStarted,
    Started,
    Status,
    Steered,
    Stopped,
    StopReason,
    Streamed,
    TestedModel,
    Unsealed,
    Unsealing,
    Usage,
)
from asia.ledger._exports import (
    describe_result,
    error_value,
    journal,
    results_table,
    validation_score_words,
    write_exports,
)
from asia.ledger._index import Brief, brief, refresh
from asia.ledger._lines import Line
from asia.ledger._published import beats, published
from asia.ledger._run import Run, RunState, find_run, metric_of, open_run
from asia.ledger._store import Store
from asia.ledger._verify import Verified, check_lock, verify
from asia.ledger._view import Experiment, SearchView, replay
from asia.ledger._words import error_line
from asia.ledger.evidence.experiment import (
    ComparedScore,
    ExperimentEvidence,
    FoldShown,
    RunSettings,
    evidence_of,
    settings_of_run,
)
from asia.ledger.evidence.findings import findings_of, put_findings
from asia.ledger.evidence.noise import noise_of_repeats
from asia.ledger.evidence.words import evidence_lines
from asia.scoring import Diagnostics

__all__ = [
    "RESUMABLE",
    "Again",
    "Brief",
    "Chain",
    "ComparedScore",
    "Control",
    "Diagnostics",
    "Evaluated",
    "Event",
    "Exchanged",
    "Experiment",
    "ExperimentEvidence",
    "Extended",
    "FoldEvidence",
    "FoldShown",
    "GuardLooked",
    "GuardScore",
    "Line",
    "Phase",
    "Proposed",
    "Refitted",
    "Resumed",
    "Run",
    "RunSettings",
    "RunState",
    "RungScored",
    "SearchView",
    "SessionEnded",
    "SessionStarted",
    "Started",
    "Status",
    "Steered",
    "StopReason",
    "Stopped",
    "Store",
    "Streamed",
    "TestedModel",
    "Unsealed",
    "Unsealing",
    "Usage",
    "Verified",
    "beats",
    "brief",
    "check_lock",
    "control",
    "control_words",
    "describe_result",
    "error_line",
    "error_value",
    "evidence_lines",
    "evidence_of",
    "find_run",
    "findings_of",
    "in_use",
    "journal",
    "metric_of",
    "noise_of_repeats",
    "open_run",
    "published",
    "put_findings",
    "read_lines",
    "refresh",
    "replay",
    "results_table",
    "settings_of_run",
    "validation_score_words",
    "verify",
    "write_exports",
    "write_whole",
]
