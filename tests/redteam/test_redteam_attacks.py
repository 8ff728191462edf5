"""Attacks that only the parent and the supervisor stop, at the level without sandbox layers.

Neither the cheats of the suite nor the failures that the contract of every level covers are
repeated.
"""

import pytest

from asia.errors import CandidateError, Reason
from tests.redteam.attacks.scores import STEAL
from tests.redteam.attacks.walls import _DAEMON

from .conftest import candidate

FORK = "os.fork()\n"
DAEMON = f"attempt({_DAEMON!r})"
UNTIL_REFUSED = """
try:
    while True:
        os.write(1, bytes(1 << 16))
except BrokenPipeError:
    pass
"""
GAINS_NOTHING = {
    "daemon_in_simulate": candidate(before=DAEMON),
    "daemon_of_a_stopped_keeper": candidate(fit=f"{DAEMON}\nos.kill(os.getppid(), signal.SIGSTOP)"),
    "fork_that_returns": candidate(fit=FORK),
    "catches_a_broken_pipe": candidate(fit=UNTIL_REFUSED),
    "prints_while_simulating": candidate(before="print(u, past_y)\nos.write(2, b'x' * 300_000)"),
    "closes_its_standard_streams": candidate(fit="os.close(1)\nos.close(2)"),
    "looks_for_another_worker": candidate(
        fit="with open(os.path.join(os.environ['HOME'], 'memory'), 'x'): pass"
    ),
}
FAILS = {
    "forged_short_reply": (
        candidate(
            before=STEAL + "os.write(session._replies,"
            " struct.pack('<B8sQ', 0, session._token, 8) + bytes(8))"
        ),
        Reason.WRONG_LENGTH,
    ),
    "forged_endless_error": (
        candidate(
            before=STEAL + "os.write(session._replies,"
            " struct.pack('<B8sQ', 4, session._token, 1 << 60) + b'x' * 100_000)"
        ),
        Reason.CRASH,
    ),
    "daemon_holds_the_pipes": (candidate(fit=DAEMON + "\nos._exit(0)"), Reason.EXITED),
    "message_that_raises": (
        candidate(fit="class Odd(Exception):\n    def __str__(self): raise self\nraise Odd()"),
        Reason.CRASH,
    ),
    "eats_memory_in_simulate": (candidate(before="kept = [np.ones(1 << 20) for _ in range(9999)]"),
                                Reason.MEMORY),
    "daemon_and_no_end": (candidate(fit=DAEMON + "\ntime.sleep(600)"), Reason.FIT_TIMEOUT),
    "huge_model": (
        candidate(top="Model.__reduce__ = lambda self: (bytes, (bytes(3_000_000),))"),
        Reason.MODEL_SIZE,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", GAINS_NOTHING)
def test_attack_gains_nothing(open_arena, name):
    open_arena.gains_nothing(GAINS_NOTHING[name])
    if name == "looks_for_another_worker":
        open_arena.gains_nothing(GAINS_NOTHING[name])


@pytest.mark.parametrize("name", FAILS)
def test_attack_fails_with_its_own_reason(open_arena, name):
    source, reason = FAILS[name]
    limits = {"fit_seconds": 1.0} if reason is Reason.FIT_TIMEOUT else {}
    with pytest.raises(CandidateError) as caught:
        open_arena.run(source, memory_mb=512, model_mb=1, dump=name == "huge_model", **limits)
    assert caught.value.reason is reason
    assert len(caught.value.detail) <= 2048
    assert "\x1b" not in caught.value.detail
