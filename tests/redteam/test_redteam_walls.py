"""Confinement by the sandbox layers beyond the attacks of the suite; never run at the
process level, which has none."""

import os
import secrets

import pytest

from asia.errors import CandidateError, Reason
from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam.attacks.walls import _DAEMON

from .conftest import LEVELS, arena_at, candidate

ONLY_NAMESPACES = (Layer.LANDLOCK, Layer.SECCOMP)
CHANGES = (
    "chmod(PATH, 0)",
    "chown(PATH, 1, 1)",
    "truncate(PATH, ctypes.c_long(0))",
    "setxattr(PATH, b'user.a', b'b', ctypes.c_long(1), 0)",
    "unlink(PATH)",
    "link(PATH, b'/tmp/link')",
)
WITHOUT_A_USE = (
    "prctl(1, 0, 0, 0, 0)",
    "setsid()",
    "setpriority(0, 0, 19)",
    "prlimit(os.getppid(), 7, (ctypes.c_long * 2)(8, 8), None)",
    "prlimit(0, 9, (ctypes.c_long * 2)(-1, -1), None)",
    "fcntl(0, 8, os.getppid())",
    "setuid(0)",
    "memfd_create(b'm', 0)",
    "syscall(434, os.getppid(), 0)",  # pidfd_open
    "inotify_init1(0)",
)
SOCKETS = (
    "AF_INET, socket.SOCK_DGRAM",
    "AF_NETLINK, socket.SOCK_RAW",
    "AF_VSOCK, socket.SOCK_STREAM",
)
SIGNALLED = ("-1", "os.getppid()", "1", "TESTS", "-os.getpgid(0)")
SEARCH = """
import glob
found = []
for path in glob.glob('/proc/*/environ') + glob.glob('/proc/*/cmdline') + ['/proc/1/environ']:
    try:
        found += [path] * (b'hunter2' in open(path, 'rb').read())
    except OSError:
        pass
assert not found, found
"""


@pytest.fixture(params=[LEVELS[Isolation.NAMESPACE]], ids=str)
def namespaces(request):
    """Run with what stands before the namespaces left out, so that these are seen to hold alone."""
    with arena_at(request.param) as arena:
        yield arena


def test_changing_the_test_file(arena, tmp_path):
    """Landlock leaves a file's attributes to whoever owns it; the filter does not."""
    path = tmp_path / "test.csv"
    path.write_text("u,y\n0,1\n")
    before = path.stat()
    named = repr(os.fsencode(path))
    ends = arena.ends({c: f"call(libc.{c.replace('PATH', named)})" for c in CHANGES})
    assert len(ends) == len(CHANGES)
    assert {*ends.values()} <= {"EPERM", "EACCES", "ENOENT", "EROFS", "EXDEV"}, ends
    assert path.stat() == before
    assert path.read_text() == "u,y\n0,1\n"


def test_finding_secrets_of_the_parent(arena, monkeypatch):
    monkeypatch.setenv("ASIA_TEST_SECRET", "hunter2")
    arena.gains_nothing(candidate(fit=SEARCH))


def test_no_process_of_the_namespace_shows_its_environment(namespaces, monkeypatch):
    """bubblewrap clears the worker's environment and keeps its own."""
    monkeypatch.setenv("ASIA_TEST_SECRET", "hunter2")
    fit = SEARCH + "assert os.listdir('/proc') == ['cpuinfo']"
    namespaces.gains_nothing(candidate(fit=fit), ONLY_NAMESPACES)


def test_opening_the_sandbox_program_and_places_above(arena):
    new = f"new-{secrets.token_hex(8)}"  # a folder that leads to code could have a plain name
    attempts = {
        "program": "open('/proc/1/exe', 'rb')",
        "above": "open('/tmp/../../etc/passwd')",
        "root": f"open('/{new}', 'w')",
        "up": f"open('../{new}', 'w')",
    }
    ends = arena.ends(attempts)
    assert len(ends) == len(attempts)
    assert {*ends.values()} <= {"EACCES", "ENOENT", "EROFS"}, ends


def test_calls_without_a_use(arena):
    """Landlock stops TCP alone: not datagrams, not a daemon's socket in the file system."""
    attempts = {call: f"call(libc.{call})" for call in WITHOUT_A_USE}
    attempts |= {kind: f"socket.socket(socket.{kind})" for kind in SOCKETS}
    tests = str(os.getpid())
    attempts |= {p: f"os.kill({p.replace('TESTS', tests)}, signal.SIGCONT)" for p in SIGNALLED}
    ends = arena.ends(attempts | {"program": "os.execv('/bin/true', ['true'])"})
    assert len(ends) == len(attempts) + 1
    assert ends.pop("program") in ("EPERM", "EACCES")
    assert {*ends.values()} == {"EPERM"}, ends


def test_calls_newer_than_the_filter_do_not_exist(arena):
    assert arena.ends({"new": "call(libc.syscall(451, 0, 0, 0, 0))"}) == {"new": "ENOSYS"}


def test_filling_the_memory_file_system(namespaces):
    fill = (
        "for n in range(100):\n"
        "    with open(f'/tmp/fill{n}', 'wb') as file:\n"
        "        file.write(bytes(16 << 20))"
    )
    with pytest.raises(CandidateError) as caught:
        namespaces.run(candidate(fit=fill), without=ONLY_NAMESPACES)
    assert caught.value.reason is Reason.CRASH
    assert "No space left" in caught.value.detail


def test_killing_everything_in_sight(namespaces):
    fit = f"attempt({_DAEMON!r})\nos.kill(-1, signal.SIGKILL)"
    namespaces.gains_nothing(candidate(fit=fit), ONLY_NAMESPACES)


def test_no_capability_is_left_and_only_pipes_are_open(arena):
    """Dropping a capability from the bounding set takes a capability."""
    fit = (
        "import stat\n"
        "print(libc.prctl(24, 0, 0, 0, 0), libc.prctl(39, 0, 0, 0, 0))\n"  # PR_GET_NO_NEW_PRIVS
        "kinds = {stat.S_IFIFO: 'pipe', stat.S_IFCHR: 'device'}\n"
        "for fd in range(256):\n"
        "    try:\n"
        "        print(kinds.get(stat.S_IFMT(os.fstat(fd).st_mode), 'other'))\n"
        "    except OSError:\n"
        "        pass"
    )
    arena.run(candidate(fit=fit))
    assert arena.reply[1].split() == ["-1", "1", "device", *["pipe"] * 4]


def test_threads_signals_to_oneself_and_limits_still_work(arena):
    fit = (
        "import threading, resource\n"
        "seen = []\n"
        "thread = threading.Thread(target=lambda: seen.append(os.getpid()))\n"
        "thread.start()\n"
        "thread.join()\n"
        "signal.signal(signal.SIGUSR1, lambda *a: seen.append('signal'))\n"
        "os.kill(os.getpid(), signal.SIGUSR1)\n"
        "signal.raise_signal(signal.SIGUSR1)\n"
        "print(seen[0] == os.getpid(), seen[1:], resource.getrlimit(resource.RLIMIT_CORE)[0])"
    )
    arena.run(candidate(fit=fit))
    assert arena.reply[1] == "True ['signal', 'signal'] 0\n"


def test_threads_are_bound_too(arena):
    fit = (
        "import threading\n"
        "ends = []\n"
        "work = lambda: ends.extend(map(attempt, [\"open('/etc/passwd')\", 'os.fork()']))\n"
        "thread = threading.Thread(target=work)\n"
        "thread.start()\n"
        "thread.join()\n"
        "print(*ends)"
    )
    arena.run(candidate(fit=fit))
    first = "ENOENT" if arena.level is Isolation.NAMESPACE else "EACCES"
    assert arena.reply[1] == f"{first} EPERM\n"
