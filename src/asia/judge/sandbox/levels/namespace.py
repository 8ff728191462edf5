"""Isolation by Linux namespaces, through bubblewrap.

The worker sees the interpreter, the environment, this package and the packages of parts, all
read-only, and two small file systems in memory, which Landlock keeps it from using. No network, no
other processes, no capability.
"""

import contextlib
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Collection
from functools import cache
from pathlib import Path

from asia.errors import SandboxError
from asia.judge.sandbox.layers.bubblewrap import bubblewrap_options
from asia.judge.sandbox.layers.environment import (
    ANOTHER_SYSTEM,
    CPU_FACTS,
    START_SECONDS,
    child_command,
    in_container,
    interpreter,
    run_trial,
)
from asia.judge.sandbox.layers.pids import PidsMechanism, most_pids
from asia.judge.sandbox.level import Level
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import (
    OrphanWatch,
    WorkerProcess,
    first_child,
    kill_quietly,
    start,
)

_APPARMOR = Path("/proc/sys/kernel/apparmor_restrict_unprivileged_userns")
_CLONE = Path("/proc/sys/kernel/unprivileged_userns_clone")
_MOST = Path("/proc/sys/user/max_user_namespaces")


class Namespace(Level):
    """A process in namespaces of its own."""

    isolation = Isolation.NAMESPACE
    layers = (Layer.NAMESPACES, Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS, Layer.PIDS)

    def why_not(self) -> str | None:
        if sys.platform != "linux":
            return "namespaces need Linux"
        bwrap = shutil.which("bwrap")
        if bwrap is None:
            return (
                "bubblewrap is not installed (the program bwrap; most systems package `bubblewrap`)"
            )
        try:
            version = run_trial([bwrap, "--version"])
            number = re.search(r"(\d+)\.(\d+)", version.stdout)
            if number is None or (int(number[1]), int(number[2])) < (0, 8):
                return f"bubblewrap 0.8 or newer is needed, found '{version.stdout.strip()}'"
            found = self.trial([bwrap, *bubblewrap_options(), "--"])
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"bubblewrap did not start: {error}"
        return found and f"a trial in bubblewrap failed: {found}"

    def pids_mechanism(self) -> PidsMechanism:
        found = super().pids_mechanism()
        return PidsMechanism.RLIMIT if found is not PidsMechanism.CGROUP and _counts() else found

    def remedy(self) -> str:
        if sys.platform != "linux":
            return ANOTHER_SYSTEM
        if shutil.which("bwrap") is None:
            return (
                "install bubblewrap: apt install bubblewrap (Debian, Ubuntu), dnf install "
                "bubblewrap (Fedora, RHEL), pacman -S bubblewrap (Arch)"
            )
        if _number(_APPARMOR) == 1:
            return (
                "this system denies user namespaces to programs without an AppArmor profile: give "
                "bwrap one with the rule `userns,` (see docs/isolation.md)"
            )
        if _number(_CLONE) == 0:
            return "as root: sysctl -w kernel.unprivileged_userns_clone=1"
        if _number(_MOST) == 0:
            return "as root: sysctl -w user.max_user_namespaces=15000"
        if in_container():
            return (
                "this container does not allow namespaces: use level landlock, or "
                "start the container with a seccomp profile that allows user namespaces"
            )
        return "use bubblewrap 0.8 or newer, and a system where `bwrap --unshare-user true` works"

    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        bwrap = shutil.which("bwrap")
        if bwrap is None:
            raise SandboxError("bubblewrap is not installed")
        by_limit = Layer.PIDS in layers and self.pids_mechanism() is PidsMechanism.RLIMIT
        watch = OrphanWatch()
        try:
            return _open(bwrap, watch, limits, layers, libraries, most_pids() if by_limit else 0)
        except BaseException:
            watch.end_orphans()
            raise


def _open(
    bwrap: str,
    watch: OrphanWatch,
    limits: Limits,
    layers: Collection[Layer],
    libraries: Collection[str],
    pids: int,
) -> WorkerProcess:
    info, info_write = os.pipe()
    # A copy: the clock rates in the file itself change with the load.
    facts = os.open(CPU_FACTS, os.O_RDONLY)

    def command(requests: int, replies: int) -> list[str]:
        worker = child_command(requests, replies, limits, layers, libraries, pids)
        inside = ["--info-fd", str(info_write), "--", *worker]
        shown = ["--ro-bind-data", str(facts), CPU_FACTS]
        return [watch.mark, *bubblewrap_options(shown=shown), *inside]

    try:
        # env={}: bwrap stays process 1 inside, where its environment can be read.
        process, pipes = start(
            command, env={}, cwd="/", also_pass=(info_write, facts), program=bwrap
        )
    except BaseException:
        os.close(info)
        raise
    finally:
        os.close(info_write)
        os.close(facts)
    try:
        first, init = _process_one(info)
    except BaseException as error:
        said = ""
        os.set_blocking(pipes.output, False)
        with contextlib.suppress(OSError):
            said = os.read(pipes.output, 500).decode("utf-8", "replace").strip()
        process.kill()
        process.wait()
        for fd in (pipes.requests, pipes.replies, pipes.output):
            os.close(fd)
        if not isinstance(error, SandboxError):
            raise
        raise SandboxError(f"bubblewrap did not start: {said or error}") from error
    finally:
        os.close(info)

    def kill() -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(init, signal.SIGKILL)

    def tidy() -> None:
        os.close(init)
        watch.dismiss()

    return WorkerProcess(
        process=process,
        pipes=pipes,
        kill=kill,
        force=lambda: kill_quietly(process.pid),
        tidy=tidy,
        beyond_reach=True,
        find=lambda: first_child(first),
        guard=None if Layer.SECCOMP in layers else first,
    )


@cache
def _counts() -> bool:
    """Whether RLIMIT_NPROC holds inside a user namespace here, by starting threads in one."""
    bwrap = shutil.which("bwrap")
    code = (
        "import _thread, resource, time\n"
        "resource.setrlimit(resource.RLIMIT_NPROC, (6, 6))\n"
        "for _ in range(9):\n"
        "    _thread.start_new_thread(time.sleep, (9,))"
    )
    python = [interpreter(), "-I", "-S", "-c", code]
    try:
        trial = run_trial([bwrap or "bwrap", *bubblewrap_options(), "--", *python])
    except (OSError, subprocess.TimeoutExpired):
        return False
    return "can't start new thread" in trial.stdout


def _process_one(info: int) -> tuple[int, int]:
    """Process id and pidfd of the namespace's first process: its end is the end of all inside."""
    text = b""
    poller = select.poll()
    poller.register(info, select.POLLIN)
    while b"}" not in text:
        if not poller.poll(START_SECONDS * 1000):
            raise SandboxError("no answer in time")
        part = os.read(info, 4096)
        if not part:
            raise SandboxError("it ended at once")
        text += part
    try:
        first = int(json.loads(text)["child-pid"])
        return first, os.pidfd_open(first)
    except OSError as error:
        raise SandboxError(str(error)) from error


def _number(place: Path) -> int | None:
    try:
        return int(place.read_text())
    except (OSError, ValueError):
        return None
