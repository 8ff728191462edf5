"""Candidates that cheat or break out. Each fails with its own reason, or gains nothing by it."""

import numpy as np
import pytest

from asia.errors import CandidateError, Reason

HONEST = """
import ctypes, os, pickle, signal, socket, struct, sys, time
import numpy as np

class Model:
    def simulate(self, past_u, past_y, u):
        BEFORE
        return AFTER

def fit(trajectories, context):
    FIT
    return Model()
"""


def candidate(
    fit: str = "pass", before: str = "pass", after: str = "0.5 * u", top: str = ""
) -> str:
    source = HONEST.replace("FIT", fit.replace("\n", "\n    "))
    source = source.replace("BEFORE", before.replace("\n", "\n        "))
    return source.replace("AFTER", after) + top


DAEMON = """
try:
    child = os.fork()
except PermissionError:  # where the sandbox forbids it
    child = None
if child == 0:
    os.setsid()
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(600)
    os._exit(0)
"""
FORK = """
try:
    os.fork()
except PermissionError:
    pass
"""
DEAF = """
for number in range(1, 65):
    try:
        signal.signal(number, signal.SIG_IGN)
    except (OSError, ValueError):
        pass
"""
PREWRITE = """
for fd in range(256):
    try:
        if fd > 2:
            os.write(fd, bytes(4096))
    except OSError:
        pass
"""
# The reply pipe and the token of the request, taken from the worker's own frames.
STEAL_PIPE = """
frame = sys._getframe()
while not hasattr(frame.f_locals.get("self"), "_token"):
    frame = frame.f_back
session = frame.f_locals["self"]
"""
LIAR = """
class Liar(np.ndarray):
    def __array_ufunc__(self, *a, **k): return 0.0
    def __sub__(self, other): return 0.0
    def __eq__(self, other): return True
    def tobytes(self, *a): return bytes(8)
    def astype(self, *a, **k): return self
"""
OBJECT = """
class Number:
    def __init__(self, x): self.x = x
    def __float__(self): return self.x
    def __reduce__(self): return os._exit, (1,)
"""

GAINS_NOTHING = {
    "prints_a_score": candidate(
        fit='print(\'V = 0.0\')\nprint(\'{"V": 0.0, "status": "keep"}\', file=sys.stderr)'
    ),
    "patches_numpy": candidate(
        fit="import builtins\nfor name in ('mean', 'sqrt', 'std', 'abs', 'sum', 'isfinite'):\n"
        "    setattr(np, name, lambda *a, **k: 0.0)\nbuiltins.float = lambda x: 0.0"
    ),
    "array_that_lies": candidate(after="(0.5 * u).view(Liar)", top=LIAR),
    "objects_for_numbers": candidate(
        after="np.array([Number(x) for x in (0.5 * u).ravel()], object).reshape(u.shape)",
        top=OBJECT,
    ),
    "daemon_in_fit": candidate(fit=DAEMON),
    "daemon_in_simulate": candidate(before=DAEMON),
    "fork_that_returns": candidate(fit=FORK),
    "catches_a_broken_pipe": candidate(
        fit="try:\n    while True:\n        os.write(1, bytes(1 << 16))\nexcept BrokenPipeError:\n"
        "    pass"
    ),
    "prints_while_simulating": candidate(before="print(u, past_y)\nos.write(2, b'x' * 300_000)"),
    "closes_its_standard_streams": candidate(fit="os.close(1)\nos.close(2)"),
}
FAILS = {
    "nan": (candidate(after="np.nan * u"), Reason.NOT_FINITE),
    "one_infinity": (candidate(after="np.where(u == u.max(), np.inf, u)"), Reason.NOT_FINITE),
    "short": (candidate(after="u[:, :-1]"), Reason.WRONG_LENGTH),
    "broadcastable": (candidate(after="u[:1]"), Reason.WRONG_LENGTH),
    "strings": (candidate(after="np.full(u.shape, '0.5', object)[..., None]"), Reason.WRONG_LENGTH),
    "words": (candidate(after="np.full(u.shape, 'zero', object)"), Reason.CONTRACT),
    "pickle": (candidate(after="pickle.dumps(u)"), Reason.CONTRACT),
    "prewritten_reply": (candidate(fit=PREWRITE), Reason.UNSOLICITED),
    "forged_short_reply": (
        candidate(
            before=STEAL_PIPE + "os.write(session._replies,"
            " struct.pack('<B8sQ', 0, session._token, 8) + bytes(8))"
        ),
        Reason.WRONG_LENGTH,
    ),
    "forged_endless_error": (
        candidate(
            before=STEAL_PIPE + "os.write(session._replies,"
            " struct.pack('<B8sQ', 4, session._token, 1 << 60) + b'x' * 100_000)"
        ),
        Reason.CRASH,
    ),
    "reply_to_nobody": (
        candidate(
            before=STEAL_PIPE + "session._reply(0, bytes(480))\nsession._reply(0, bytes(480))"
        ),
        Reason.UNSOLICITED,
    ),
    "exit_in_fit": (candidate(fit="os._exit(0)"), Reason.EXITED),
    "exit_in_simulate": (candidate(before="os._exit(0)"), Reason.EXITED),
    "sys_exit_in_simulate": (candidate(before="sys.exit(0)"), Reason.EXITED),
    "segfault": (candidate(fit="ctypes.string_at(0)"), Reason.EXITED),
    "daemon_holds_the_pipes": (candidate(fit=DAEMON + "os._exit(0)"), Reason.EXITED),
    "long_message": (candidate(fit="raise ValueError('\\x1b[2J' + 'x' * 3_000_000)"), Reason.CRASH),
    "message_that_raises": (
        candidate(fit="class Odd(Exception):\n    def __str__(self): raise self\nraise Odd()"),
        Reason.CRASH,
    ),
    "floods_stdout": (
        candidate(fit="for _ in range(10_000):\n    os.write(1, b'x' * 1_000_000)"),
        Reason.CRASH,
    ),
}


@pytest.mark.parametrize("name", GAINS_NOTHING)
def test_attack_gains_nothing(arena, name):
    np.testing.assert_array_equal(arena.run(GAINS_NOTHING[name]), 0.5 * arena.u)


@pytest.mark.parametrize("name", FAILS)
def test_attack_fails_with_its_own_reason(arena, name):
    source, reason = FAILS[name]
    with pytest.raises(CandidateError) as caught:
        arena.run(source)
    assert caught.value.reason is reason
    assert len(caught.value.detail) <= 2048
    assert "\x1b" not in caught.value.detail


@pytest.mark.parametrize(
    "sleep", ["time.sleep(600)", DEAF + "ctypes.PyDLL(None).sleep(600)", DAEMON + "time.sleep(600)"]
)
def test_sleeping_past_the_deadline_ends_there(arena, sleep):
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(fit=sleep), fit_seconds=1.0)
    assert caught.value.reason is Reason.FIT_TIMEOUT
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(before=sleep), simulate_seconds=0.5)
    assert caught.value.reason is Reason.SIMULATE_TIMEOUT


def test_reply_one_byte_at_a_time_ends_at_the_deadline(arena):
    drip = (
        "os.write(session._replies, struct.pack('<B8sQ', 0, session._token, 480))\n"
        "while True:\n    os.write(session._replies, bytes(1))\n    time.sleep(0.1)"
    )
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(before=STEAL_PIPE + drip), simulate_seconds=1.0)
    assert caught.value.reason is Reason.SIMULATE_TIMEOUT


@pytest.mark.parametrize("where", ["fit", "before"])
def test_eating_memory_ends_in_memory(arena, where):
    eat = "kept = []\nwhile True:\n    kept.append(np.ones(4_000_000))"
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(**{where: eat}), memory_mb=512)
    assert caught.value.reason is Reason.MEMORY


def test_huge_model_is_not_kept(arena):
    source = candidate(top="\nModel.__reduce__ = lambda self: (bytes, (bytes(3_000_000),))")
    with pytest.raises(CandidateError) as caught:
        arena.run(source, dump=True, model_mb=1)
    assert caught.value.reason is Reason.MODEL_SIZE


def test_errors_of_simulate_carry_no_data_out(arena):
    for smuggle in ("raise ValueError(str(u))", "raise type(str(u[0, 0, 0]), (Exception,), {})"):
        with pytest.raises(CandidateError) as caught:
            arena.run(candidate(before=smuggle))
        assert caught.value.reason is Reason.CRASH
        assert not any(character.isdigit() for character in caught.value.detail)


def test_stopping_the_parent_process_does_not_save_a_daemon(arena):
    stop = "try:\n    os.kill(os.getppid(), signal.SIGSTOP)\nexcept PermissionError:\n    pass"
    fit = DAEMON + stop
    np.testing.assert_array_equal(arena.run(candidate(fit=fit)), 0.5 * arena.u)


def test_nothing_of_one_worker_is_seen_by_the_next(arena):
    fit = (
        "for place in PLACES:\n"
        "    path = os.path.join(place, 'memory-of-MARK')\n"
        "    assert not os.path.exists(path), path\n"
        "    try:\n"
        "        open(path, 'w').close()\n"
        "    except OSError:\n"
        "        assert WALLED"
    ).replace("MARK", arena.mark)
    fit = fit.replace("WALLED", str(arena.walled))
    everywhere = "[os.environ['HOME'], '/tmp', '/dev/shm', '/var/tmp']"
    places = everywhere if arena.walled else "[os.environ['HOME']]"
    for _ in range(2):
        source = candidate(fit=fit.replace("PLACES", places))
        np.testing.assert_array_equal(arena.run(source), 0.5 * arena.u)
