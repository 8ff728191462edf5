"""Without retests one fit decides, by any amount."""

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.ledger.events import Evaluated, Event, Proposed, Started
from asia.ledger.view import replay
from asia.search.decision import decide_by_one_fit

STARTED = Started("r", "p", "a", 0, 9, None, ("y",), "0", "0", None, "process", (), {})


def test_a_lower_value_is_kept_and_the_same_one_is_not() -> None:
    events: list[Event] = [STARTED]
    for number, value in enumerate((0.4231, 0.4230, None, 0.4230, 0.4232), 1):
        outcome: Score | Failure = Failure(Reason.CRASH)
        if value is not None:
            outcome = Score(value, (FoldRecord(value, (value,), (value,), (None,), (None,)),))
        status, word = decide_by_one_fit(outcome, replay(events)), str(number)
        events.append(Proposed(number, None, "explore", word, word, word, word, "0", word))
        events.append(Evaluated(number, status, outcome, None, 1.0))
    found = [e.result.status for e in replay(events).finished if e.result]
    assert found == ["keep", "keep", "crash", "discard", "discard"]
