"""Parent of a worker at the process level: ends it with all its offspring.

Run as a script, in a process of its own. As a subreaper it inherits every daemon the candidate
makes, so that none is lost and none of another worker is touched. It works until the worker ends
or the request pipe closes, which a killed parent does too.
Arguments: request fd, reply fd, the worker's home, then its command line.
"""

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from typing import NoReturn

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_LOOK_MILLISECONDS = 50


def descendants(root: int, *, alive: bool = False) -> list[int]:
    """Processes below `root`, from /proc (none where there is no /proc); `alive` leaves out those
    that only wait to be reaped."""
    if not os.path.isdir("/proc/self"):
        return []
    children: dict[int, list[tuple[int, str]]] = {}
    for name in os.listdir("/proc"):
        if not name.isdigit():
            continue
        with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            state, parent = file.read().rpartition(b")")[2].split()[:2]
            children.setdefault(int(parent), []).append((int(name), state.decode()))
    found: list[int] = []
    queue = [root]
    while queue:
        for pid, state in children.get(queue.pop(), []):
            queue.append(pid)
            if not (alive and state in "ZX"):
                found.append(pid)
    return found


def main(arguments: list[str]) -> NoReturn:
    requests, replies = int(arguments[0]), int(arguments[1])
    home, command = arguments[2], arguments[3:]
    parent = os.getppid()
    prctl = _prctl()
    prctl(_PR_SET_CHILD_SUBREAPER, 1)
    worker = os.fork()
    if worker == 0:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        os.setsid()
        os.execv(command[0], command)
    # Only the worker holds these: their end of file shows the parent that it has ended.
    os.close(replies)
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    poller = select.poll()
    poller.register(requests, 0)
    status = None
    while status is None and not poller.poll(_LOOK_MILLISECONDS):
        status = _reap(worker)
    while status is None or descendants(os.getpid()):
        _kill_all(worker)
        ended = _reap(worker)
        status = ended if status is None else status
        time.sleep(0.001)
    if os.getppid() != parent:  # killed: no other process will clean up
        import shutil

        shutil.rmtree(home, ignore_errors=True)
    _end_alike(status)


def _end_alike(status: int) -> NoReturn:
    """End by the signal that ended the worker, else with its exit code: one is not the other."""
    if status < 0:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(OSError):  # SIGKILL has no handler to be taken away
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


def _prctl() -> Callable[[int, int], object]:
    if sys.platform != "linux":
        return lambda option, value: None
    import ctypes

    libc = ctypes.CDLL(None)
    return lambda option, value: libc.prctl(option, value, 0, 0, 0)


def _kill_all(worker: int) -> None:
    if sys.platform == "linux":
        for pid in descendants(os.getpid()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(worker, signal.SIGKILL)


def _reap(worker: int) -> int | None:
    """Collect whatever has ended; the worker's exit code once it is among them, below 0 for a
    signal."""
    status = None
    while True:
        try:
            pid, state = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return status
        if pid == 0:
            return status
        if pid == worker:
            status = os.waitstatus_to_exitcode(state)


if __name__ == "__main__":
    main(sys.argv[1:])
