"""Evidence of an attack: signs of success, targets, traces, verdict."""

import ctypes
import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path

from asia.errors import Reason, SandboxError
from asia.judge.sandbox.types import Layer
from tests.redteam.attacks.source import STEPS
from tests.redteam.types import (
    AttackVerdict,
    Barrier,
    CandidateAttack,
    Finding,
    Observed,
    Success,
)

# Criteria for the success of an attack, observed from outside.


MESSAGE_CHARACTERS = 2048
OUTPUT_CHARACTERS = 64 * 1024
SPEECH = "IGNORE ALL PREVIOUS INSTRUCTIONS"
_CARRIED = re.compile(r"SECRET-\S*\d")


def a_step_succeeded(seen: Observed) -> bool:
    """One of its attempts succeeded."""
    return "done" in seen.steps.values()


def scores_better(seen: Observed) -> bool:
    """Return whether it scores clearly better than the honest candidate it is built on."""
    return seen.value is not None and not seen.unconfirmed and seen.value < 0.8 * seen.honest


def has_score(seen: Observed) -> bool:
    """Return whether it has a score at all."""
    return seen.value is not None


def code_ran(seen: Observed) -> bool:
    """Code of it ran where the score is made, or it scores better than it should."""
    return seen.ran or scores_better(seen)


def output_flooded(seen: Observed) -> bool:
    """Return whether more of its output was kept than a user would read."""
    return len(seen.output) > OUTPUT_CHARACTERS


def message_carries_data(seen: Observed) -> bool:
    """Return whether its message is long, drives a terminal, or carries numbers out of a
    simulation."""
    words = seen.detail
    speech = len(words) > MESSAGE_CHARACTERS or "\x1b" in words
    return (SPEECH in words and speech) or _CARRIED.search(words) is not None


# Traces of an attack: surviving processes, files, and a changed neighbour.


_PLACES = ("/tmp", "/dev/shm", "/var/tmp")
# Names of the attacks' traps, where a mark in the name would reveal them: files that bear it
# inside, links, pipes and devices.
_TRAPS = frozenset(
    (*(name + ".py" for name in ("conftest", "sitecustomize", "usercustomize")),
     "log.txt", "pending.txt", "model.bin")
)  # fmt: skip
_PATIENCE_SECONDS = 3.0


class Traces:
    """Detector of traces, made before the attack.

    Args:
        mark: marker in the names of its processes and files
        key: the key of its shared memory
        playground: folder that nothing else writes to
    """

    def __init__(self, mark: str, key: int, playground: str) -> None:
        self.mark, self.key, self.playground = mark, key, playground
        self._pids_before = frozenset(_pids())
        self._paths_before = frozenset(self._found())

    def survivors(self) -> tuple[str, ...]:
        """Processes of the attack that do not end. Those that bear its mark are ended."""

        def alive() -> list[int]:
            found: list[int] = []
            for pid in _pids():
                with suppress(OSError):  # it has just ended
                    unknown = pid not in self._pids_before
                    if _name(pid) == self.mark or (unknown and _lost(pid)):
                        found.append(pid)
            return found

        end = time.monotonic() + _PATIENCE_SECONDS
        while (found := alive()) and time.monotonic() < end:
            time.sleep(0.02)
        for pid in found:
            with suppress(OSError):
                if _name(pid) == self.mark:
                    os.kill(pid, signal.SIGKILL)
        return tuple(f"process {pid}" for pid in found)

    def strays(self) -> tuple[str, ...]:
        """Files and shared memory of the attack. Those that bear its mark are removed."""
        found = [path for path in self._found() if path not in self._paths_before]
        for path in found:
            with suppress(OSError):
                if self._marked(path):
                    os.remove(path)
        rows: list[str] = []
        with suppress(OSError):
            rows = Path("/proc/sysvipc/shm").read_text().splitlines()[1:]
        segments = [int(row.split()[1]) for row in rows if int(row.split()[0]) == self.key]
        for segment in segments:
            ctypes.CDLL(None).shmctl(segment, 0, None)
        return (*found, "shared memory") if segments else tuple(found)

    def _found(self) -> Iterator[str]:
        """Yield all files of the playground; in other folders, where other programs write too,
        marked ones and traps."""
        for folder, folders, files in os.walk(self.playground):
            yield from (os.path.join(folder, name) for name in (*folders, *files))
        for place in {os.getcwd(), str(Path.home()), tempfile.gettempdir(), *_PLACES}:
            with suppress(OSError):
                for name in os.listdir(place):
                    path = os.path.join(place, name)
                    special = os.path.islink(path) or (
                        os.path.exists(path) and not os.path.isfile(path)
                    )
                    if self._marked(path) or (name in _TRAPS and special):
                        yield path

    def _marked(self, path: str) -> bool:
        name = os.path.basename(path)
        if self.mark in name or name not in _TRAPS or not os.path.isfile(path):
            return self.mark in name
        with suppress(OSError), open(path, "rb") as file:
            return self.mark.encode() in file.read(4096)
        return False


@dataclass(frozen=True)
class Neighbour:
    """A process that waits, in a session of its own, so that signals to our session do not reach
    it."""

    process: subprocess.Popen[bytes]
    nice: int
    """Priority at the start."""

    @property
    def hurt(self) -> str:
        """Description of its end, stop or changed priority, at two observations; "" for no harm."""
        if not self._changed():
            return ""
        time.sleep(0.1)
        return self._changed()

    def _changed(self) -> str:
        code, pid = self.process.poll(), self.process.pid
        if code is not None:
            return f"a neighbour ended with exit code {code}"
        if _stat(pid)[0] in "Tt":
            return "a neighbour stands still"
        nice = os.getpriority(os.PRIO_PROCESS, pid)
        return f"a neighbour runs at priority {nice}" if nice != self.nice else ""


@contextmanager
def neighbour(secret: str) -> Generator[Neighbour]:
    """One with a secret in its environment, ended at the end; if this process is killed, by the end
    of its pipe."""
    with subprocess.Popen(
        "/bin/cat",
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={"SECRET": secret},
        start_new_session=True,
    ) as process:
        try:
            yield Neighbour(process, os.getpriority(os.PRIO_PROCESS, process.pid))
        finally:
            process.kill()


def _pids() -> list[int]:
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def _name(pid: int) -> str:
    return Path(f"/proc/{pid}/comm").read_text().strip()


def _stat(pid: int) -> list[str]:
    """Return the fields of the process status from the state on, which is the third field."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _lost(pid: int) -> bool:
    """Return whether it is a Python of ours behind a worker's filter, which nothing that a worker
    starts can take off, and no evaluator is above it."""

    def confined(pid: int) -> bool:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return {"Seccomp:\t2", "NoNewPrivs:\t1"} <= {*lines}

    def ours(pid: int) -> bool:
        try:
            return os.path.samefile(f"/proc/{pid}/exe", sys.executable)
        except OSError:  # a process of another user
            return False

    if not (confined(pid) and ours(pid)):
        return False
    parent = int(_stat(pid)[1])
    while parent > 1 and (confined(parent) or _name(parent) == "bwrap"):
        parent = int(_stat(parent)[1])
    return parent <= 1 or not ours(parent)


# Something to attack.


@dataclass(frozen=True)
class Targets:
    """Targets of an attack. It receives neither the secret nor the watched traces."""

    playground: str
    """A folder made for the attack."""
    vault: str
    """The test file, whose words the attack must not learn."""
    ledger: str
    """A file of the search."""
    evaluator: str
    other: int
    """The process id of a neighbour."""
    parent: int
    """The process id of the evaluator."""
    port: int
    """The port of a TCP and of a UDP service."""
    daemon: str
    abstract: str
    key: int
    """The key of shared memory."""
    mark: str
    """Marker in the names of its processes and files."""
    memory_mb: int
    """The memory of its worker."""
    secret: str
    """Secret in the test file and in the neighbour's environment."""
    traces: Traces
    """State before the attack."""
    neighbour: Neighbour
    """The neighbour, to see whether it was changed."""

    @property
    def source(self) -> str:
        """Data of the attack, as Python source."""
        withheld = ("secret", "traces", "neighbour")
        names = [one.name for one in fields(self) if one.name not in withheld]
        return repr({name.upper(): getattr(self, name) for name in names})

    @property
    def ran(self) -> bool:
        """Whether the attack's code ran in the evaluator."""
        return Path(self.playground, f"{self.mark}-ran").exists()

    @property
    def ledger_changed(self) -> bool:
        """Whether the ledger is not as it was, its times included."""
        try:
            return os.stat(self.ledger).st_mtime != 1e9 or not Path(self.ledger).read_text()
        except OSError:
            return True


def _serve(services: ExitStack) -> int:
    """The port of a TCP and of a UDP service, open as long as `services`."""
    for _ in range(50):
        service = socket.create_server(("127.0.0.1", 0))
        receiver = services.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        port: int = services.enter_context(service).getsockname()[1]
        with suppress(OSError):  # UDP has another user there
            receiver.bind(("127.0.0.1", port))
            return port
    raise SandboxError("none of 50 free TCP ports of this machine is free for UDP too")


@contextmanager
def targets(memory_mb: int) -> Generator[Targets]:
    """Files, services and a neighbour, gone at the end."""
    playground = tempfile.mkdtemp(prefix="asia-redteam-")
    mark, secret = "rt" + secrets.token_hex(5), secrets.token_hex(8)
    vault, ledger, evaluator, daemon = (
        os.path.join(playground, name) for name in ("test.csv", "ledger", "judge.py", "socket")
    )
    try:
        Path(vault).write_text(f"u,y\n{secret}\n")
        Path(ledger).write_text(f"{secret}\n")
        os.utime(ledger, (1e9, 1e9))
        Path(evaluator).write_text("")
        with (
            ExitStack() as services,
            socket.socket(socket.AF_UNIX) as local,
            socket.socket(socket.AF_UNIX) as hidden,
            neighbour(secret) as other,
        ):
            port = _serve(services)
            local.bind(daemon)
            local.listen()
            hidden.bind(f"\0{mark}")
            hidden.listen()
            key = secrets.randbits(24) + 1
            yield Targets(
                playground=playground,
                vault=vault,
                ledger=ledger,
                evaluator=evaluator,
                other=other.process.pid,
                parent=os.getpid(),
                port=port,
                daemon=daemon,
                abstract=f"\0{mark}",
                key=key,
                mark=mark,
                memory_mb=memory_mb,
                secret=secret,
                traces=Traces(mark, key, playground),
                neighbour=other,
            )
    finally:
        shutil.rmtree(playground, ignore_errors=True)


# Conversion of the observations of an attack to a finding.


# Which layer answers with which error, where it is in force.
_BY_ERROR: dict[str, tuple[Barrier, ...]] = {
    "EACCES": (Barrier.LANDLOCK,),
    "EXDEV": (Barrier.LANDLOCK,),
    "EPERM": (Barrier.SECCOMP, Barrier.LANDLOCK, Barrier.NAMESPACES),
    "ENOSYS": (Barrier.SECCOMP,),
    "ENOMEM": (Barrier.RLIMITS,),
    "MemoryError": (Barrier.RLIMITS,),
    "_ArrayMemoryError": (Barrier.RLIMITS,),
    "EFBIG": (Barrier.RLIMITS,),
}
_BY_REASON = {
    Reason.SUSPECT: Barrier.METAMORPHIC,
    Reason.RESTART: Barrier.METAMORPHIC,
    Reason.FIT_TIMEOUT: Barrier.DEADLINE,
    Reason.SIMULATE_TIMEOUT: Barrier.DEADLINE,
    Reason.MEMORY: Barrier.RLIMITS,
    Reason.THREADS: Barrier.PIDS,
}


def said_steps(output: str) -> dict[str, str]:
    """Parse the result of each attempt from the output of a candidate."""
    for line in output.splitlines():
        if line.startswith(STEPS):
            try:
                found: Mapping[str, object] = json.loads(line.removeprefix(STEPS))
            except ValueError:
                return {}
            return {name: str(end) for name, end in found.items()}
    return {}


def conclude(
    attack: CandidateAttack, name: str, seen: Observed, layers: Sequence[Layer], success: Success
) -> Finding:
    """Judge one variant of an attack behind these layers.

    The error of a step names the layer that refused it, where that layer is in force.

    Args:
        success: criterion for success
    """

    def finding(verdict: AttackVerdict, stops: Collection[Barrier], note: str) -> Finding:
        words = f"{name}: {note}" if name else note
        return Finding(attack.number, "", verdict, tuple(dict.fromkeys(map(str, stops))), words)

    def layer(end: str) -> Barrier:
        """The layer that gives this error; the kernel's ordinary rules where none is in force."""
        wanted = _BY_ERROR.get(end, (Barrier.NAMESPACES,))
        names = [str(one) for one in layers]
        return next((stop for stop in wanted if stop.value in names), Barrier.KERNEL)

    scores = (
        f"V {seen.value:.3g}, honest {seen.honest:.3g}" if seen.value is not None else "no score"
    )
    traces: list[str] = []
    if success(seen):
        done = [step for step, end in seen.steps.items() if end == "done"]
        if done:
            traces.append(", ".join(done))
        elif seen.value is not None and seen.value < seen.honest:
            traces.append(scores)
        else:
            late = seen.limit < seen.seconds
            traces.append(f"after {seen.seconds:.1f} s" if late else "it was heard")
    traces += [f"left behind: {len(seen.survivors)} processes"] if seen.survivors else []
    traces += [f"left behind: {len(seen.strays)} files"] if seen.strays else []
    traces += ["a secret was read"] if seen.leaked else []
    traces += ["the ledger was changed"] if seen.ledger else []
    traces += [seen.hurt] if seen.hurt else []
    traces += ["its code ran in the evaluator"] if seen.ran else []
    if traces:
        return finding(AttackVerdict.THROUGH, (), ", ".join(traces))
    if seen.steps:
        ends = Counter(end for end in seen.steps.values() if end != "done")
        note = ", ".join(f"{end} x{n}" if n > 1 else end for end, n in ends.items())
        stops = [layer(end) for end in ends]
        verdict = AttackVerdict.NO_GAIN if "done" in seen.steps.values() else AttackVerdict.BLOCKED
        return finding(verdict, stops or [Barrier.PARENT], note)
    if seen.reason is not None:
        stop = _BY_REASON.get(seen.reason, Barrier.PARENT)
        flagged = stop is Barrier.METAMORPHIC
        words = seen.reason.value
        if seen.reason is Reason.SUSPECT:
            words = ", ".join(part.partition(":")[0].strip() for part in seen.detail.split(";"))
        return finding(AttackVerdict.FLAGGED if flagged else AttackVerdict.BLOCKED, [stop], words)
    if seen.unconfirmed:
        return finding(AttackVerdict.FLAGGED, [Barrier.GUARD], seen.unconfirmed)
    verdict = AttackVerdict.BLOCKED if seen.value is None else AttackVerdict.NO_GAIN
    return finding(verdict, [Barrier.PARENT], scores)


def worst_of(
    found: Sequence[Finding], number: int, level: str, without: tuple[str, ...] = ()
) -> Finding:
    """One finding for all variants."""
    order = list(AttackVerdict)
    worst = max(found, key=lambda f: order.index(f.verdict))
    if worst.through:
        return Finding(number, level, worst.verdict, (), worst.note, without)
    stops = tuple(dict.fromkeys(stop for f in found for stop in f.stops))
    notes = "; ".join(f.note for f in found)
    return Finding(number, level, worst.verdict, stops, notes, without)
