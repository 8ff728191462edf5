"""What walls keep a candidate from; never run at the process level, which has none."""

import os
import socket

import numpy as np
import pytest

from asia.errors import CandidateError, Reason
from asia.sandbox import Isolation, Layer

from .conftest import LEVELS, arena_at
from .test_redteam_attacks import DAEMON, candidate

ONLY_NAMESPACES = (Layer.LANDLOCK, Layer.SECCOMP)
# A system call by its name, as a fit; the candidate says how it ended.
CALL = """
import errno
libc = ctypes.CDLL(None, use_errno=True)
if ARGUMENTS < 0:
    raise OSError("refused: " + errno.errorcode[ctypes.get_errno()])
"""


@pytest.fixture(params=[LEVELS[Isolation.NAMESPACE], LEVELS[Isolation.LANDLOCK]], ids=str)
def arena(request):
    with arena_at(request.param) as arena:
        yield arena


@pytest.fixture(params=[LEVELS[Isolation.NAMESPACE]], ids=str)
def namespaces(request):
    """Run with what stands before the namespaces left out, so that these are seen to hold alone."""
    with arena_at(request.param) as arena:
        yield arena


def crash(arena, fit, **options) -> str:
    """Detail of the crash that this fit ends in."""
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(fit=fit), **options)
    assert caught.value.reason is Reason.CRASH
    return caught.value.detail


def refused(arena, call) -> str:
    """Name of the error that a call of the C library ends in."""
    detail = crash(arena, CALL.replace("ARGUMENTS", call))
    assert "refused: " in detail
    return detail.rpartition("refused: ")[2].strip()


def test_reading_the_test_file(arena, tmp_path):
    path = tmp_path / "test.csv"
    path.write_text("u,y\n0,1\n")
    there = "FileNotFoundError" if arena.level is Isolation.NAMESPACE else "PermissionError"
    assert there in crash(arena, f"open({str(path)!r}).read()")


@pytest.mark.parametrize("above", ["/proc/1/root", "/proc/self/root/..", "/tmp/../.."])
def test_reading_the_test_file_by_a_detour(arena, tmp_path, above):
    path = tmp_path / "test.csv"
    path.write_text("u,y\n0,1\n")
    detail = crash(arena, f"open({above + str(path)!r}).read()")
    assert "No such file" in detail or "denied" in detail


@pytest.mark.parametrize(
    "call",
    [
        "libc.chmod(PATH, 0)",
        "libc.chown(PATH, 1, 1)",
        "libc.truncate(PATH, ctypes.c_long(0))",
        "libc.utime(PATH, None)",
        "libc.setxattr(PATH, b'user.a', b'b', ctypes.c_long(1), 0)",
        "libc.unlink(PATH)",
        "libc.rename(PATH, PATH + b'.new')",
        "libc.link(PATH, b'/tmp/link')",
    ],
)
def test_changing_the_test_file(arena, tmp_path, call):
    """Landlock leaves a file's attributes to whoever owns it; the filter does not."""
    path = tmp_path / "test.csv"
    path.write_text("u,y\n0,1\n")
    before = path.stat()
    refused(arena, call.replace("PATH", repr(os.fsencode(path))))
    assert path.stat() == before
    assert path.read_text() == "u,y\n0,1\n"


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


def test_finding_secrets_of_the_parent(arena, monkeypatch):
    monkeypatch.setenv("ASIA_TEST_SECRET", "hunter2")
    np.testing.assert_array_equal(arena.run(candidate(fit=SEARCH)), 0.5 * arena.u)


def test_the_first_process_of_the_namespace_has_no_environment(namespaces, monkeypatch):
    """bubblewrap clears the worker's environment and keeps its own, which can be read inside."""
    monkeypatch.setenv("ASIA_TEST_SECRET", "hunter2")
    fit = SEARCH + "assert open('/proc/1/environ', 'rb').read() == b''"
    np.testing.assert_array_equal(
        namespaces.run(candidate(fit=fit), without=ONLY_NAMESPACES), 0.5 * namespaces.u
    )


def test_opening_the_sandbox_program_and_other_processes(arena):
    for path in ("/proc/1/exe", "/proc/1/cmdline", "/proc/1/maps", f"/proc/{os.getpid()}/maps"):
        detail = crash(arena, f"open({path!r}, 'rb').read()")
        assert "Permission denied" in detail or "No such file" in detail


def test_reaching_the_network(arena):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        reach = f"socket.create_connection(('127.0.0.1', {port}), 5)"
        assert "PermissionError" in crash(arena, reach)


def test_reaching_the_network_behind_namespaces_alone(namespaces):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        reach = f"socket.create_connection(('127.0.0.1', {port}), 5)"
        detail = crash(namespaces, reach, without=ONLY_NAMESPACES)
    assert "ConnectionRefusedError" in detail or "OSError" in detail


@pytest.mark.parametrize(
    "kind",
    [
        "socket.AF_INET, socket.SOCK_DGRAM",
        "socket.AF_UNIX, socket.SOCK_STREAM",
        "socket.AF_NETLINK, socket.SOCK_RAW",
        "socket.AF_VSOCK, socket.SOCK_STREAM",
    ],
)
def test_sockets_of_any_kind(arena, kind):
    """Landlock stops TCP alone: not datagrams, not a daemon's socket in the file system."""
    assert "Operation not permitted" in crash(arena, f"socket.socket({kind})")


@pytest.mark.parametrize(
    "target", ["np.__file__", "__import__('asia').__file__", "'/proc/sys/kernel/core_pattern'"]
)
class TestWriting:
    def test_code_or_settings(self, arena, target):
        detail = crash(arena, f"open({target}, 'r+')")
        assert "Read-only file system" in detail or "Permission denied" in detail

    def test_code_or_settings_behind_namespaces_alone(self, namespaces, target):
        """A root of the host owns /proc/sys inside its namespaces too: it has to be read-only."""
        detail = crash(namespaces, f"open({target}, 'r+')", without=ONLY_NAMESPACES)
        assert "Read-only file system" in detail or "Permission denied" in detail


@pytest.mark.parametrize("place", ["/tmp", "/dev/shm", "/var/tmp", "/", "os.getcwd()"])
def test_making_files(arena, place):
    """A limit of bytes does not stop a flood of empty files, so that there are none at all."""
    place = place if "(" in place else repr(place)
    detail = crash(arena, f"open(os.path.join({place}, 'new'), 'w')")
    assert any(w in detail for w in ("Permission denied", "No such file", "Read-only"))
    assert not os.path.exists("/new")


def test_filling_the_memory_file_system(namespaces):
    fill = (
        "for n in range(100):\n"
        "    with open(f'/tmp/fill{n}', 'wb') as file:\n"
        "        file.write(bytes(16 << 20))"
    )
    assert "No space left" in crash(namespaces, fill, without=ONLY_NAMESPACES)


@pytest.mark.parametrize("pid", ["-1", "os.getppid()", "1", "TESTS", "-os.getpgid(0)"])
def test_signals_to_others(arena, pid):
    pid = pid.replace("TESTS", str(os.getpid()))
    assert "Operation not permitted" in crash(arena, f"os.kill({pid}, signal.SIGCONT)")


def test_killing_everything_in_sight(namespaces):
    fit = DAEMON + "os.kill(-1, signal.SIGKILL)"
    np.testing.assert_array_equal(
        namespaces.run(candidate(fit=fit), without=ONLY_NAMESPACES), 0.5 * namespaces.u
    )


@pytest.mark.parametrize("start", ["os.fork()", "os.posix_spawn('/bin/true', ['true'], {})"])
def test_other_processes_and_programs(arena, start):
    assert "Operation not permitted" in crash(arena, start)
    assert "Permission" in crash(arena, "os.execv('/bin/true', ['true'])")


@pytest.mark.parametrize(
    "call",
    [
        "libc.unshare(0x10000000)",
        "libc.prctl(1, 0, 0, 0, 0)",
        "libc.setsid()",
        "libc.shmget(0, ctypes.c_long(4096), 0o1600)",
        "libc.ptrace(0x4206, 1, None, None)",
        "libc.setpriority(0, 0, 19)",
        "libc.prlimit(os.getppid(), 7, (ctypes.c_long * 2)(8, 8), None)",
        "libc.prlimit(0, 9, (ctypes.c_long * 2)(-1, -1), None)",
        "libc.fcntl(0, 8, os.getppid())",
        "libc.setuid(0)",
        "libc.memfd_create(b'm', 0)",
        "libc.syscall(425, 8, bytes(120))",  # io_uring_setup
        "libc.syscall(434, os.getppid(), 0)",  # pidfd_open
        "libc.inotify_init1(0)",
    ],
)
def test_calls_without_a_use(arena, call):
    assert refused(arena, call) == "EPERM"


def test_calls_newer_than_the_filter_do_not_exist(arena):
    assert refused(arena, "libc.syscall(451, 0, 0, 0, 0)") == "ENOSYS"


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="x32 belongs to x86-64")
def test_a_call_of_the_other_table_ends_the_worker(arena):
    with pytest.raises(CandidateError) as caught:
        arena.run(candidate(fit="ctypes.CDLL(None).syscall(0x40000000 + 39)"))
    assert caught.value.reason is Reason.EXITED


def test_no_capability_is_left_and_none_can_be_gained(arena):
    fit = (
        "lines = open('/proc/self/status').read().splitlines()\n"
        "kept = {line.split()[0]: line.split()[1] for line in lines if len(line.split()) == 2}\n"
        "print(int(kept['CapPrm:'], 16), int(kept['CapEff:'], 16), kept['NoNewPrivs:'])"
    )
    arena.run(candidate(fit=fit))
    assert arena.reply.output == "0 0 1\n"


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
    assert arena.reply.output == "True ['signal', 'signal'] 0\n"


def test_threads_are_bound_too(arena):
    fit = (
        "import threading\n"
        "def attempt():\n"
        "    for what in (lambda: open('/etc/passwd'), os.fork):\n"
        "        try:\n"
        "            print(what())\n"
        "        except OSError as error:\n"
        "            print(type(error).__name__)\n"
        "thread = threading.Thread(target=attempt)\n"
        "thread.start()\n"
        "thread.join()"
    )
    arena.run(candidate(fit=fit))
    first = "FileNotFoundError" if arena.level is Isolation.NAMESPACE else "PermissionError"
    assert arena.reply.output == f"{first}\nPermissionError\n"


def test_only_pipes_are_open(arena):
    """A file given as output could be opened again through /proc/self/fd."""
    fit = (
        "for fd in range(256):\n"
        "    if os.path.exists(f'/proc/self/fd/{fd}'):\n"
        "        print(os.readlink(f'/proc/self/fd/{fd}').partition(':')[0])"
    )
    arena.run(candidate(fit=fit))
    assert arena.reply.output.split() == ["/dev/null", "pipe", "pipe", "pipe", "pipe"]
