import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import (
    Evaluated,
    Event,
    Proposed,
    ReferenceScored,
    Started,
    Steered,
    Stopped,
)


def score(value: float) -> Score:
    fold = FoldRecord(value, (value,), (value,), (50.0,), (0.75,))
    return Score(value, (fold, fold))


def started() -> Started:
    return Started(
        run="toy",
        problem="toy",
        agent="expert",
        seed=0,
        experiments=3,
        hours=None,
        outputs=("y",),
        lock_digest="0" * 64,
        protocol_digest="1" * 64,
        test_digest=None,
        isolation="process",
        isolation_notes=(),
        environment={},
    )


def proposed(store: Store, number: int) -> Proposed:
    source = store.put(f"# candidate {number}\n".encode())
    return Proposed(number, None, "explore", "linear", f"t{number}", "h", "e", source, str(number))


def evaluated(number: int, status: str, outcome: Score | Failure) -> Evaluated:
    return Evaluated(number, status, outcome, None, 1.0)  # type: ignore[arg-type]


def finished_run(directory: Path) -> Path:
    """A run that `verify` finds whole: its lock, its artifacts, and a result for each proposal."""
    store = Store(directory / "artifacts")
    lock = b"made up\n"
    start = replace(started(), lock_digest=hashlib.sha256(lock).hexdigest())
    fold = replace(
        score(0.4).folds[0],
        **{name: store.put(name.encode()) for name in ("model", "y_hat", "curve")},
        diagnostics=Diagnostics(0.1, 0.0, 0.2, 0.3, 1.0, 1.0, 1.0, 0.0),
        fit_seconds=2.5,
    )
    events: list[Event] = [
        start,
        ReferenceScored("linear model", score(0.5)),
        proposed(store, 1),
        Evaluated(1, "keep", Score(0.4, (fold, fold)), store.put(b"printed"), 1.0),
        Steered("try a slower pole – τ ≈ 3 s"),
        proposed(store, 2),
        evaluated(2, "crash", Failure(Reason.CRASH, "Traceback\nValueError: x", 1)),
        Stopped("user"),
    ]
    with Chain(directory / "ledger.jsonl") as chain:
        for event in events:
            chain.append(event)
    (directory / "problem.lock.toml").write_bytes(lock)
    return directory


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """See `finished_run`."""
    return finished_run(tmp_path / "whole")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A short search, written through the ledger; outcomes are made up."""
    directory = tmp_path / "toy"
    store = Store(directory / "artifacts")
    events: list[Event] = [
        started(),
        ReferenceScored("linear model", score(0.5)),
        proposed(store, 1),
        evaluated(1, "keep", score(0.4)),
        proposed(store, 2),
        evaluated(2, "crash", Failure(Reason.CRASH, "Traceback\nValueError: x", 1)),
        proposed(store, 3),
        evaluated(3, "keep", score(0.3)),
    ]
    with Chain(directory / "ledger.jsonl") as chain:
        for event in events:
            chain.append(event)
    return directory
