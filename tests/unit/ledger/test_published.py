"""The Ladder: what is told of scores, and what is kept."""

from dataclasses import replace

import pytest

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure, FoldScore, Score
from asia.ledger.events import Evaluated, Event, Proposed, Started
from asia.ledger.view import SearchView, published, replay
from asia.search.decision import beats, decide_by_one_fit

STARTED = Started(
    "r", "p", "a", 0, 9, None, ("y",), "0", "0", None, "process", (), {}, ladder=0.1
)  # fmt: skip


def score(value: float, parts: tuple[float, ...] = ()) -> Score:
    parts = parts or tuple(value * k for k in (0.9, 1.0, 1.1))
    return Score(value, (FoldScore(value, (value,), (value,), (None,), (None,), parts),) * 2)


def search(*outcomes: Score | float | None, ladder: float | None = 0.1) -> SearchView:
    """A search in which candidates scored so, decided as the loop does; None is a failure."""
    events: list[Event] = [replace(STARTED, ladder=ladder)]
    for number, found in enumerate(outcomes, 1):
        outcome = Failure(Reason.CRASH) if found is None else found
        outcome = score(outcome) if isinstance(outcome, float) else outcome
        status, word = decide_by_one_fit(outcome, replay(events)), str(number)
        events.append(Proposed(number, None, "explore", word, word, word, word, "0", word))
        events.append(Evaluated(number, status, outcome, (), None, 1.0))
    return replay(events)


def told(view: SearchView) -> list[float | None]:
    return [e.score.value if e.score else None for e in published(view).experiments]


def statuses(view: SearchView) -> list[str]:
    return [e.result.status for e in view.finished if e.result]


def test_only_steps_down_are_told() -> None:
    view = search(0.42, 0.40, 0.39, 0.35, None, 0.33, 0.9)
    first, second = 0.9**8, 0.9**10
    assert told(view) == pytest.approx([first] * 3 + [second, None, second, second])
    assert statuses(view) == ["keep", "discard", "discard", "keep", "crash", "discard", "discard"]
    assert all(e.score.folds == () for e in published(view).experiments if e.score)
    assert view.best is not None
    assert view.best.number == 4


def test_a_gain_in_one_part_is_no_new_best() -> None:
    start = score(0.42, (0.40, 0.42, 0.44))
    everywhere, somewhere = score(0.30, (0.29, 0.30, 0.31)), score(0.30, (0.40, 0.42, 0.01))
    assert statuses(search(start, everywhere)) == ["keep", "keep"]
    assert statuses(search(start, somewhere)) == ["keep", "discard"]
    assert statuses(search(start, somewhere, ladder=None)) == ["keep", "keep"]


def test_the_record_keeps_all_of_v() -> None:
    scores = [e.score.value for e in search(0.4231, 0.4172).experiments if e.score]
    assert scores == [0.4231, 0.4172]


def test_what_is_told_does_not_tell_two_losers_apart() -> None:
    near, far = search(0.3, 0.2901), search(0.3, 7.0)
    assert told(near) == told(far)
    assert statuses(near) == statuses(far)


def test_told_twice_is_told_once() -> None:
    view = search(0.4231, 0.35, 0.34)
    assert published(published(view)) == published(view)


def test_a_perfect_score_is_told() -> None:
    assert told(search(0.3, score(0.0, (0.0, 0.0, 0.0)))) == pytest.approx([0.9**11, 0.0])


def test_without_a_ladder_all_of_v_is_told() -> None:
    view = search(0.4231, 0.4230, 0.4232, ladder=None)
    assert published(view) is view
    assert statuses(view) == ["keep", "keep", "discard"]
    assert beats(score(0.42299), view)
    assert not beats(score(0.4230), view)


def told_detail(reason: Reason, detail: str) -> str:
    events: list[Event] = [STARTED]
    events.append(Proposed(1, None, "explore", "a", "a", "a", "a", "0", "a"))
    events.append(Evaluated(1, reason.status, Failure(reason, detail), (), None, 12.34))
    (experiment,) = published(replay(events)).experiments
    assert experiment.failure is not None
    assert experiment.result is not None
    assert experiment.result.seconds == 12.0
    return experiment.failure.detail


FRAME = 'Traceback:\n  File "candidate.py", line 12, in fit\n    x\n'


@pytest.mark.parametrize(
    ("reason", "detail", "expected"),
    [
        (Reason.CRASH, FRAME + "ValueError: 0.123", 'File "candidate.py", line 12\nValueError'),
        (
            Reason.CRASH,
            FRAME + "E0123: x",
            'File "candidate.py", line 12\nan exception of its own',
        ),
        (Reason.CRASH, 'File "candidate.py", line 1234567, in fit\nKeyError: 1', "KeyError"),
        (Reason.EXITED, "exit code 3; last printed: 0.123", ""),
        (Reason.MEMORY, "MemoryError", "MemoryError"),
        (Reason.CONTRACT, "fit returned M0123, which has no simulate method", ""),
        (Reason.MODEL_SIZE, "100123456 bytes, the limit is 64 MB", ""),
        (Reason.WRONG_LENGTH, "got shape (1, 2, ?), expected (1, 2, 3)", ""),
        (Reason.SOURCE_SIZE, "the source has 70000 bytes", "the source has 70000 bytes"),
        (Reason.THREADS, "at most 272 threads", "at most 272 threads"),
    ],
)
def test_the_ladder_lets_no_words_of_a_candidate_through(
    reason: Reason, detail: str, expected: str
) -> None:
    assert told_detail(reason, detail) == expected
