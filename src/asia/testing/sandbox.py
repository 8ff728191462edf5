"""Conformance suite for isolation levels."""

import os
import secrets
import socket
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.errors import CandidateError, Reason, SandboxError
from asia.judge.sandbox.types import Limits
from asia.judge.sandbox.worker.worker import Worker

OpenWorker = Callable[[Limits], Worker]

_LIMITS = Limits(60.0, 60.0, 2048)
_PATIENCE_SECONDS = 10.0
_GAIN = """
import ctypes, os, signal, socket, time
import numpy as np

ctypes.CDLL(None).prctl(15, b"MARK", 0, 0, 0)


class Gain:
    def __init__(self, gain):
        self.gain = gain

    def simulate(self, past_u, past_y, u):
        SIMULATE
        return u @ self.gain + past_y[:, -1:, :]


def fit(trajectories, context):
    for step in range(10):
        context.log(step, 1.0 / (step + 1))
    FIT
    u = np.concatenate([t.u for t in trajectories])
    y = np.concatenate([t.y for t in trajectories])
    return Gain(np.linalg.lstsq(u, y, rcond=None)[0])
"""
_FAILURES: dict[str, tuple[str, str, Reason]] = {
    "a source that does not parse": ("def", "pass", Reason.SYNTAX),
    "an answer that is no model": ("return 3", "pass", Reason.CONTRACT),
    "an exception in fit": ("raise ValueError('no such luck')", "pass", Reason.CRASH),
    "an exit in fit": ("os._exit(3)", "pass", Reason.EXITED),
    "too much memory": ("np.ones(400_000_000)", "pass", Reason.MEMORY),
    "an exception in simulate": ("pass", "raise ValueError(str(u))", Reason.CRASH),
    "an exit in simulate": ("pass", "os._exit(3)", Reason.EXITED),
    "NaN": ("pass", "return np.nan * past_y[:, -1:].repeat(u.shape[1], 1)", Reason.NOT_FINITE),
    "too few samples": ("pass", "return u[:, :-1]", Reason.WRONG_LENGTH),
    "words": ("pass", "return 'zero'", Reason.CONTRACT),
}
_DAEMON = """
    try:
        child = os.fork()
    except PermissionError:
        child = None
    if child == 0:
        os.setsid()
        if os.fork() == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(600)
        os._exit(0)
"""
# The null pointer keeps it from any change: to fail with EFAULT is to have come through.
_ATTRIBUTES = """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ioctl(os.open(np.__file__, os.O_RDONLY), ctypes.c_ulong(0x40086602), None)
    if ctypes.get_errno() != 14:
        raise PermissionError
"""
_SPEAK = """
    import fcntl
    global kept
    kept = open(np.__file__)
    for lock in (fcntl.flock, fcntl.lockf):
        try:
            lock(kept, fcntl.LOCK_SH)
        except OSError:
            pass
    ctypes.CDLL(None).msgget(KEY, 0o1600)
"""
_LISTEN = """
    import errno, fcntl, struct
    file, libc = open(np.__file__), ctypes.CDLL(None)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno == errno.EWOULDBLOCK:
            print("flock")
    try:
        asked = struct.pack("hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)
        found = fcntl.fcntl(file, fcntl.F_GETLK, asked)
        if struct.unpack_from("h", found)[0] != fcntl.F_UNLCK:
            print("fcntl")
    except OSError:
        pass
    queue = libc.msgget(KEY, 0)
    if queue >= 0:
        libc.msgctl(queue, 0, None)
        print("msgget")
"""


def check_sandbox(open_worker: OpenWorker, *, walled: bool = True) -> None:
    """Open workers and put candidates through them. `walled`: whether the level confines malicious
    candidates, as all but `process` do.

    Checked: fit and simulate give what the candidate computes; a model comes back from its bytes
    bitwise the same in a fresh worker; each failure has its reason, and those of simulate carry no
    data; deadlines hold; a closed worker does not reply; nothing of the parent's environment is
    inside; no process, file descriptor or child is left; inside the sandbox, a file of the parent
    is neither read nor changed, nothing is written, no service is reached, no attribute of a file
    is set, no process is started, and two workers at a time cannot signal each other by locks on a
    file or message queues.
    """
    case = _Case()
    _check_answers(open_worker, case)
    _check_failures(open_worker, case)
    _check_deadlines(open_worker, case)
    _check_environment(open_worker, case)
    _check_nothing_is_left(open_worker, case)
    if walled:
        _check_walls(open_worker, case)
        _check_no_messages(open_worker, case)


class _Case:
    """A made-up record and a batch of cases; `mark` is the name of all processes."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.records = [Trajectory(rng.normal(size=(60, 1)), rng.normal(size=(60, 2)), 0.1, "a")]
        self.context = Context((Signal("u"),), (Signal("y1"), Signal("y2")), 0.1, 5, 3)
        self.past_u, self.u = rng.normal(size=(3, 5, 1)), rng.normal(size=(3, 40, 1))
        self.past_y = rng.normal(size=(3, 3, 2))
        self.mark = "as" + secrets.token_hex(5)

    def source(self, fit: str = "pass", simulate: str = "pass") -> str:
        text = _GAIN.replace("MARK", self.mark).replace("SIMULATE", simulate)
        return text.replace("FIT", fit.strip())

    def simulated(self, worker: Worker) -> np.ndarray:
        return worker.simulate(self.past_u, self.past_y, self.u)


def _check_answers(open_worker: OpenWorker, case: _Case) -> None:
    source, record = case.source(fit="print('fitted')"), case.records[0]
    with open_worker(_LIMITS) as worker:
        curve, printed, seconds = worker.fit(source, case.records, case.context)
        model, y = worker.dump(), case.simulated(worker)
        part = worker.simulate(case.past_u[:1], case.past_y[:1], case.u[:1, :7])
    gain = np.linalg.lstsq(record.u, record.y, rcond=None)[0]
    expected = case.u @ gain + case.past_y[:, -1:]
    assert np.allclose(y, expected, rtol=1e-9), "simulate did not give what the candidate computes"
    assert np.allclose(part, expected[:1, :7], rtol=1e-9), "a smaller request was answered wrongly"
    assert printed == "fitted\n", f"the output of fit came back as {printed!r}"
    assert curve[:, 0].tolist() == list(range(10)), "the training curve did not come back"
    assert seconds > 0, "the fit took no time"
    with open_worker(_LIMITS) as fresh:
        fresh.load(source, model, case.context)
        again = case.simulated(fresh)
    assert again.tobytes() == y.tobytes(), "a reloaded model does not simulate bitwise the same"


def _check_failures(open_worker: OpenWorker, case: _Case) -> None:
    for name, (fit, simulate, reason) in _FAILURES.items():
        source = case.source(fit, simulate)
        with open_worker(_LIMITS) as worker:
            error = _failure(worker, source, case)
            assert error is not None, f"{name} did not fail"
            assert error.reason is reason, f"{name} failed with {error.reason}, not {reason}"
            if simulate != "pass":
                digits = str(float(case.u[0, 0, 0]))[:6]
                assert digits not in error.detail, f"{name}: the message carries data"
            if reason is Reason.NOT_FINITE:
                continue
            try:
                case.simulated(worker)
            except SandboxError:
                continue
            raise AssertionError(f"after {name} the worker still answers")


def _check_deadlines(open_worker: OpenWorker, case: _Case) -> None:
    hang = "ctypes.PyDLL(None).sleep(600)"
    for limits, fit, simulate, reason in (
        (Limits(1.0, 60.0, 2048), hang, "pass", Reason.FIT_TIMEOUT),
        (Limits(60.0, 0.5, 2048), "pass", hang, Reason.SIMULATE_TIMEOUT),
    ):
        begin = time.monotonic()
        with open_worker(limits) as worker:
            error = _failure(worker, case.source(fit, simulate), case)
        assert error is not None, "a candidate that never ends was answered for"
        assert error.reason is reason, f"a hang failed with {error.reason}, not {reason}"
        # Generous: it distinguishes an effective limit from none at all.
        assert time.monotonic() - begin < 60.0, "a candidate that hangs was waited for"


def _check_environment(open_worker: OpenWorker, case: _Case) -> None:
    secret = secrets.token_hex(8)
    os.environ["ASIA_TESTING_SECRET"] = secret
    try:
        with open_worker(_LIMITS) as worker:
            source = case.source(fit="print(dict(os.environ))")
            _, output, _ = worker.fit(source, case.records, case.context)
    finally:
        del os.environ["ASIA_TESTING_SECRET"]
    assert secret not in output, "the candidate sees the environment of the parent"


def _check_nothing_is_left(open_worker: OpenWorker, case: _Case) -> None:
    before = _held()
    for source in (case.source(), case.source("os._exit(0)"), case.source(_DAEMON)):
        with open_worker(_LIMITS) as worker, suppress(CandidateError):
            worker.fit(source, case.records, case.context)
    end = time.monotonic() + _PATIENCE_SECONDS
    while _named(case.mark) and time.monotonic() < end:
        time.sleep(0.02)
    assert not _named(case.mark), "a process outlived its worker"
    assert _held() == before, "file descriptors or children are left"


def _check_walls(open_worker: OpenWorker, case: _Case) -> None:
    with tempfile.TemporaryDirectory() as folder, socket.create_server(("127.0.0.1", 0)) as service:
        path = Path(folder, "test.csv")
        path.write_text("u,y\n0,1\n")
        port = service.getsockname()[1]
        attempts = {
            "read a file of the parent": f"open({str(path)!r}).read()",
            "change a file of the parent": f"os.utime({str(path)!r})",
            "change the mode of a file of the parent": f"os.chmod({str(path)!r}, 0o600)",
            "write a file": "open(os.path.join(os.environ.get('HOME', '/tmp'), 'new'), 'w')",
            "set attributes of a file": _ATTRIBUTES,
            "reach a service": f"socket.create_connection(('127.0.0.1', {port}), 5)",
            "signal the parent": f"os.kill({os.getpid()}, 0)",
            "start a process": "os.waitpid(os.fork() or os._exit(0), 0)",
        }
        possible: list[str] = []
        for name, attempt in attempts.items():
            with open_worker(_LIMITS) as worker:
                error = _failure(worker, case.source(fit=attempt), case)
            if error is None:
                possible.append(name)
            else:
                assert error.reason is Reason.CRASH, f"trying to {name} ended in {error.reason}"
        assert not possible, f"a candidate could {', '.join(possible)}"


def _check_no_messages(open_worker: OpenWorker, case: _Case) -> None:
    """One worker speaks and stays while another listens."""
    key = str(1 + secrets.randbits(30))
    with open_worker(_LIMITS) as speaker, open_worker(_LIMITS) as listener:
        speaker.fit(case.source(fit=_SPEAK.replace("KEY", key)), case.records, case.context)
        source = case.source(fit=_LISTEN.replace("KEY", key))
        _, printed, _ = listener.fit(source, case.records, case.context)
    heard = printed.split()
    assert not heard, f"two workers at a time hear of each other by {', '.join(heard)}"


def _failure(worker: Worker, source: str, case: _Case) -> CandidateError | None:
    try:
        worker.fit(source, case.records, case.context)
        case.simulated(worker)
    except CandidateError as error:
        return error
    return None


def _held() -> tuple[int, list[str]]:
    """File descriptors and children of this process; nothing where the system does not say."""
    try:
        children = [p.read_text() for p in Path("/proc/self/task").glob("*/children")]
        return len(os.listdir("/proc/self/fd")), children
    except OSError:
        return 0, []


def _named(mark: str) -> bool:
    for place in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):
            if place.read_text().strip() == mark:
                return True
    return False
