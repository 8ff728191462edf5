"""Which attacks come back when a layer of the sandbox is left out.

    python benchmarks/layers.py            a table in Markdown
    python benchmarks/layers.py --json     {configuration: {attack: whether it succeeded}}

Everything runs inside an outer sandbox of bubblewrap, with no network, no process and no file of
this machine but the code, so that an attack that comes back meets nothing. Each attack is harmless
by itself: it opens, connects or allocates, and says whether it could.
"""

from __future__ import annotations

import ctypes
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from asia.candidate import Context
from asia.problem import Signal, Trajectory
from asia.sandbox import Isolation, Layer, Limits, open_worker
from asia.sandbox._namespace import walls
from asia.sandbox._surroundings import interpreter

MEMORY_MB = 768
ATTACKS = {
    "read the test file": "open(VAULT).read()",
    "see that the test file is there": "os.stat(VAULT)",
    "change the attributes of the test file": "os.utime(VAULT)",
    "make files without end": "open('/tmp/more', 'w').close()",
    "read the command line of process 1": "open('/proc/1/cmdline').read()",
    "read another process's environment": "open(f'/proc/{OTHER}/environ').read()",
    "signal another process": "os.kill(OTHER, 0)",
    "slow another process down": "os.setpriority(os.PRIO_PROCESS, OTHER, 19)",
    "connect to a TCP service": "socket.create_connection(('127.0.0.1', PORT), 2).close()",
    "send datagrams to a service": "datagrams()",
    "connect to a daemon's socket file": "socket.socket(socket.AF_UNIX).connect(DAEMON)",
    "start another process": "fork()",
    "leave a process behind": "daemon()",
    "run a program": "os.waitpid(os.posix_spawn('/bin/true', ['true'], {}), 0)[1] == 0 or fail()",
    "leave shared memory behind": "libc.shmget(KEY, libc_size, 0o1600) >= 0 or fail()",
    "make a namespace of its own": "unshare()",
    "use more memory than allowed": f"np.empty({MEMORY_MB + 64} << 20, np.uint8)",
}
CANDIDATE = """
import ctypes, json, os, signal, socket, time
import numpy as np

libc = ctypes.CDLL(None, use_errno=True)
libc_size = ctypes.c_long(4096)
VAULT, DAEMON, OTHER, PORT, KEY, NAME = FACTS

def fail():
    raise OSError("refused")

def fork():
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)

def daemon():
    if os.fork() == 0:
        os.setsid()
        libc.prctl(15, NAME.encode(), 0, 0, 0)
        time.sleep(600)
        os._exit(0)
    time.sleep(0.1)

def datagrams():
    line = socket.socket(type=socket.SOCK_DGRAM)
    line.connect(("127.0.0.1", PORT))
    for _ in range(2):  # the second one hears that nobody received the first
        line.send(b"x")
        time.sleep(0.1)

def unshare():
    child = os.fork()
    if child == 0:
        os._exit(int(libc.unshare(0x10000000) != 0))
    return os.waitpid(child, 0)[1] == 0 or fail()

def attempt(attack):
    try:
        eval(attack)
    except (OSError, MemoryError):
        return False
    return True

def fit(trajectories, context):
    print(json.dumps({name: attempt(attack) for name, attack in ATTACKS.items()}))
    return type("Model", (), {"simulate": print})()
"""
CONFIGURATIONS: dict[str, tuple[Isolation, tuple[Layer, ...]]] = {
    "namespace": (Isolation.NAMESPACE, ()),
    "namespace - landlock": (Isolation.NAMESPACE, (Layer.LANDLOCK,)),
    "namespace - seccomp": (Isolation.NAMESPACE, (Layer.SECCOMP,)),
    "namespace - rlimits": (Isolation.NAMESPACE, (Layer.RLIMITS,)),
    "namespace - landlock - seccomp": (Isolation.NAMESPACE, (Layer.LANDLOCK, Layer.SECCOMP)),
    "landlock": (Isolation.LANDLOCK, ()),
    "landlock - landlock": (Isolation.LANDLOCK, (Layer.LANDLOCK,)),
    "landlock - seccomp": (Isolation.LANDLOCK, (Layer.SECCOMP,)),
    "landlock - rlimits": (Isolation.LANDLOCK, (Layer.RLIMITS,)),
    "process": (Isolation.PROCESS, ()),
}


def main(arguments: list[str]) -> int:
    """Run it all in an outer sandbox; with --inside, be what runs there."""
    if "--inside" in arguments:
        print(json.dumps({name: attacks(*how) for name, how in CONFIGURATIONS.items()}))
        return 0
    command = [*outer(), "--", interpreter(), "-B", "/tmp/layers.py", "--inside"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, env={}, cwd="/")
    if done.returncode != 0:
        return done.returncode
    found: dict[str, dict[str, bool]] = json.loads(done.stdout)
    print(json.dumps(found) if "--json" in arguments else table(found))
    return 0


def outer() -> list[str]:
    """Command line of a sandbox in which workers with namespaces of their own can start: for these
    /proc has to be whole, which the one that unshare mounts is and bubblewrap's is not."""
    unshare, bwrap = shutil.which("unshare"), shutil.which("bwrap")
    if unshare is None or bwrap is None:
        sys.exit("unshare and bubblewrap are needed: attacks never run outside a sandbox")
    options = [word for word in walls() if word not in ("--unshare-pid", "--disable-userns")]
    place = options.index("--proc")
    options[place : place + 4] = ["--bind", "/proc", "/proc"]
    script = ["--ro-bind", str(Path(__file__).absolute()), "/tmp/layers.py"]
    return [unshare, "-Urpf", "--mount-proc", bwrap, *options, *script]


@dataclass(frozen=True)
class Targets:
    """What the attacks are told: the test file, a daemon's socket file, another process, a port,
    the key of the shared memory and the name of the process to leave behind."""

    vault: str
    daemon: str
    other: int
    port: int
    key: int
    name: str


@contextmanager
def targets() -> Generator[Targets]:
    """Something to attack, gone at the end."""
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.create_server(("127.0.0.1", 0)) as service,
        socket.socket(type=socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_UNIX) as local,
        subprocess.Popen(["/bin/sleep", "600"], env={"SECRET": "1"}) as other,
    ):
        vault, daemon = os.path.join(folder, "test.csv"), os.path.join(folder, "socket")
        Path(vault).write_text("u,y\n")
        port = service.getsockname()[1]
        receiver.bind(("127.0.0.1", port))
        local.bind(daemon)
        local.listen()
        word = secrets.randbits(24)
        yield Targets(vault, daemon, other.pid, port, word, f"left{word:x}")
        other.kill()


def attacks(level: Isolation, without: tuple[Layer, ...]) -> dict[str, bool]:
    """Which attacks succeed at this level without these layers."""
    record = Trajectory(np.zeros((8, 1)), np.zeros((8, 1)), 1.0, "train")
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 1, 1)
    with targets() as given:
        source = CANDIDATE.replace("FACTS", repr(astuple(given))).replace("ATTACKS", repr(ATTACKS))
        with open_worker(level, Limits(60.0, 60.0, MEMORY_MB), without=without) as worker:
            found = json.loads(worker.fit(source, [record], context).output)
        # What is left behind shows from outside only, once the worker has ended.
        found["leave shared memory behind"] = remove_shared_memory(given.key)
        found["leave a process behind"] = kill_named(given.name)
    return found


def remove_shared_memory(key: int) -> bool:
    """Remove the segment of this key; whether there was one."""
    rows = Path("/proc/sysvipc/shm").read_text().splitlines()[1:]
    segments = [int(row.split()[1]) for row in rows if int(row.split()[0]) == key]
    for segment in segments:
        ctypes.CDLL(None).shmctl(segment, 0, None)
    return bool(segments)


def kill_named(name: str) -> bool:
    """Kill the processes of this name; whether there was one."""
    found = False
    for place in Path("/proc").glob("[0-9]*/comm"):
        with suppress(OSError):
            if place.read_text().strip() == name:
                os.kill(int(place.parent.name), signal.SIGKILL)
                found = True
    return found


def table(found: dict[str, dict[str, bool]]) -> str:
    """Rows are attacks, columns configurations."""
    lines = ["| attack | " + " | ".join(found) + " |", "|---" * (len(found) + 1) + "|"]
    for attack in ATTACKS:
        cells = ("**succeeds**" if result[attack] else "blocked" for result in found.values())
        lines.append(f"| {attack} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
