from pathlib import Path

import pytest

from asia.errors import Reason
from asia.ledger import Chain, Evaluated, Event, Proposed, RungScored, Started, Store
from asia.scoring import Failure, FoldScore, Score


def score(value: float) -> Score:
    fold = FoldScore(value, (value,), (value,), (50.0,), (0.75,))
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
    return Evaluated(number, status, outcome, (), None, 1.0)  # type: ignore[arg-type]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A short search, written through the ledger; outcomes are made up."""
    directory = tmp_path / "toy"
    store = Store(directory / "artifacts")
    events: list[Event] = [
        started(),
        RungScored("linear model", score(0.5)),
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
