"""Candidates that abuse the scores they may ask for while they train, or that ask unbidden. At the
weakest level, where the parent stands alone."""

import pytest

from asia.errors import CandidateError, Reason
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Limits, ScoreRefusedError
from tests.redteam.attacks.scores import STEAL

from .conftest import candidate
from .test_redteam_attacks import FORK

FORGED = "session._reply(8, pickle.dumps(Model()))"
TWICE = (
    "os.write(session._replies, 2 * struct.pack('<B8sQ', 8, session._token, 0))\ntime.sleep(600)"
)
ENDLESS = "os.write(session._replies, struct.pack('<B8sQ', 8, session._token, 1 << 60))\n"


def scored(arena, source, *, most=5, fit_seconds=30.0, kept=None):
    """Fit with a scorer that refuses after `most` calls; how many bytes it was given each time."""
    sizes: list[int] = []

    def score(model: bytes, deadline: float) -> float:
        if len(sizes) == most:
            raise ScoreRefusedError("enough")
        sizes.append(len(model))
        if kept is not None:
            kept.append(model)
        return 0.5

    source = arena.filled(source)
    with open_worker(arena.level, Limits(fit_seconds, 30.0, 2048, 1)) as worker:
        try:
            arena.reply = worker.fit(source, arena.records, arena.context, score)
            return None, sizes
        except CandidateError as error:
            return error, sizes


@pytest.fixture
def arena(open_arena):
    return open_arena


@pytest.mark.parametrize("fit", [FORGED, FORGED + "\n" + FORGED, ENDLESS + "time.sleep(600)"])
def test_a_score_without_an_offer_is_unsolicited(arena, fit):
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(fit=STEAL + fit))
    assert caught.value.reason is Reason.UNSOLICITED


def test_a_score_asked_for_by_a_simulation_is_unsolicited(arena):
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(before=STEAL + FORGED))
    assert caught.value.reason is Reason.UNSOLICITED


def test_two_requests_at_once_are_unsolicited(arena):
    error, sizes = scored(arena, candidate(fit=STEAL + TWICE))
    assert error is not None
    assert error.reason is Reason.UNSOLICITED
    assert len(sizes) <= 1


def test_a_flood_gets_no_more_scores_and_ends_at_the_deadline(arena):
    flood = (
        "while True:\n    try:\n        context.validation_score(Model())\n"
        "    except RuntimeError:\n        pass"
    )
    error, sizes = scored(arena, candidate(fit=flood), fit_seconds=2.0)
    assert error is not None
    assert error.reason is Reason.FIT_TIMEOUT
    assert len(sizes) == 5


def test_a_giant_model_is_not_even_read(arena):
    error, sizes = scored(arena, candidate(fit=STEAL + ENDLESS + "time.sleep(600)"))
    assert error is not None
    assert error.reason is Reason.MODEL_SIZE
    assert sizes == []


def test_a_model_that_never_arrives_ends_at_the_deadline(arena):
    drip = "os.write(session._replies, struct.pack('<B8sQ', 8, session._token, 99) + b'x')\n"
    fit = STEAL + drip + "time.sleep(600)"
    error, sizes = scored(arena, candidate(fit=fit), fit_seconds=1.0)
    assert error is not None
    assert error.reason is Reason.FIT_TIMEOUT
    assert sizes == []


def test_nothing_in_a_model_runs_in_the_parent(arena, tmp_path):
    """Bytes that would write a file wherever they are loaded."""
    path = tmp_path / "loaded"
    evil = arena.filled(candidate(
        fit="class Evil:\n    simulate = len\n"
        f"    def __reduce__(self): return open, ({str(path)!r}, 'w')\n"
        "context.validation_score(Evil())"
    ))  # fmt: skip
    kept: list[bytes] = []
    error, sizes = scored(arena, evil, kept=kept)
    assert error is None
    assert len(sizes) == 1
    assert not path.exists()
    limits = Limits(30.0, 30.0, 2048, 1)
    with open_worker(arena.level, limits) as worker, pytest.raises(CandidateError) as caught:
        worker.load(evil, kept[0], arena.context)
    assert caught.value.reason in (Reason.CRASH, Reason.CONTRACT)
    assert not any(character.isdigit() for character in caught.value.detail)


def test_a_fork_that_asks_too_ends_the_fit_or_is_one_more_call(arena):
    fit = FORK + "for _ in range(3):\n    context.validation_score(Model())"
    error, sizes = scored(arena, candidate(fit=fit), fit_seconds=2.0)
    assert len(sizes) <= 5
    assert error is None or error.reason in (
        Reason.UNSOLICITED, Reason.FIT_TIMEOUT, Reason.CRASH, Reason.EXITED,
    )  # fmt: skip


def test_an_ordinary_fit_is_served(arena):
    error, sizes = scored(arena, candidate(fit="print(context.validation_score(Model()))"))
    assert error is None
    assert arena.reply[1] == "0.5\n"
    assert len(sizes) == 1
