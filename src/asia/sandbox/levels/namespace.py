"""Isolation by Linux namespaces, through bubblewrap.

The worker sees the interpreter, the environment and this package, all read-only, and two small
file systems in memory, which Landlock keeps it from using. No network, no other processes, no
capability.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping
from typing import Literal

from asia.errors import SandboxError
from asia.sandbox._types import Layer, Limits
from asia.sandbox.walls.surroundings import (
    SYSTEM_FILES,
    child_command,
    code_folders,
    environment,
    interpreter,
    interpreter_links,
)
from asia.sandbox.worker.cell import Cell, PipePairs, kill_quietly, parent_ends, start

Shared = Literal["net", "pid"]
_HOME = "/tmp/scratch"
_TMP_BYTES = 64 * 1024 * 1024
_SHM_BYTES = 16 * 1024 * 1024
_OLDEST = (0, 8)
_START_SECONDS = 20.0


def why_not() -> str | None:
    """None if a Python really starts in a namespace here, else the reason in plain words."""
    if sys.platform != "linux":
        return "namespaces need Linux"
    bwrap = shutil.which("bwrap")
    if bwrap is None:
        return "bubblewrap is not installed (the program bwrap; most systems package `bubblewrap`)"
    try:
        version = _run([bwrap, "--version"])
        found = re.search(r"(\d+)\.(\d+)", version.stdout)
        if found is None or (int(found[1]), int(found[2])) < _OLDEST:
            return f"bubblewrap 0.8 or newer is needed, found '{version.stdout.strip()}'"
        trial = _run([bwrap, *worker_walls(), "--", interpreter(), "-I", "-S", "-c", "pass"])
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"bubblewrap did not start: {error}"
    if trial.returncode != 0:
        last = (trial.stdout.strip().splitlines() or ["no message"])[-1]
        return f"bubblewrap could not start Python: {last[:200]}"
    return None


def open_cell(limits: Limits, layers: Collection[Layer]) -> Cell:
    """Start a worker in its own namespaces, with these layers besides. Raises SandboxError."""
    bwrap = shutil.which("bwrap")
    if bwrap is None:
        raise SandboxError("bubblewrap is not installed")
    pipes = PipePairs(os.pipe(), os.pipe())
    info, info_write = os.pipe()
    worker = child_command(*pipes.child_ends, limits, layers)
    command = [bwrap, *worker_walls(), "--info-fd", str(info_write), "--", *worker]
    try:
        # env={}: bwrap stays process 1 inside, where its environment can be read.
        process = start(command, pipes, env={}, cwd="/", also_pass=(info_write,))
    except SandboxError:
        os.close(info)
        raise
    finally:
        os.close(info_write)
    ends = parent_ends(process, pipes)
    try:
        init = _process_one(info)
    except BaseException as error:
        said = _last_words(ends.output)
        process.kill()
        process.wait()
        for fd in (ends.requests, ends.replies, ends.output):
            os.close(fd)
        if not isinstance(error, SandboxError):
            raise
        raise SandboxError(f"bubblewrap did not start: {said or error}") from error
    finally:
        os.close(info)

    def kill() -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(init, signal.SIGKILL)

    return Cell(
        process=process,
        pipes=ends,
        kill=kill,
        force=lambda: kill_quietly(process.pid),
        tidy=lambda: os.close(init),
        beyond_reach=True,
    )


def worker_walls(
    tmp_bytes: int = _TMP_BYTES, *, shared: Collection[Shared] = (), nesting: bool = False
) -> list[str]:
    """bwrap options of a worker, up to the command. `shared`, `nesting`: as of `walls`."""
    memory = {"/dev/shm": _SHM_BYTES, "/tmp": tmp_bytes}
    options = walls(memory, _HOME, ["--chdir", _HOME], shared=shared, nesting=nesting)
    options += ["--uid", "65534", "--gid", "65534", "--hostname", "sandbox", "--clearenv"]
    for name, value in environment(_HOME).items():
        options += ["--setenv", name, value]
    return options


def walls(
    memory: Mapping[str, int],
    folder: str,
    shown: Collection[str],
    *,
    files: Collection[str] = (),
    shared: Collection[Shared] = (),
    nesting: bool = False,
) -> list[str]:
    """bwrap options that show code alone, read-only. memory: bytes of each file system in memory;
    folder: one to make; shown: options after the code's; files: of the system, where they exist;
    shared: namespaces that stay the caller's, with its /proc; nesting: whether more can be made."""
    spaces = ("user", "ipc", "pid", "net", "uts", "cgroup-try")
    options = [f"--unshare-{space}" for space in spaces if space not in shared]
    options += [] if nesting else ["--disable-userns"]
    options += ["--die-with-parent", "--new-session", "--ro-bind", "/usr", "/usr"]
    for name in ("/bin", "/sbin", "/lib", "/lib32", "/lib64"):
        if os.path.islink(name):
            options += ["--symlink", os.readlink(name), name]
        elif os.path.isdir(name):
            options += ["--ro-bind", name, name]
    options += ["--dir", "/etc"]
    for name in (*SYSTEM_FILES, *files):
        options += ["--ro-bind-try", name, name]
    # A root of the host owns /proc/sys inside too: without the remount it could write there.
    own = ["--proc", "/proc", "--remount-ro", "/proc"]
    options += [*(["--bind", "/proc", "/proc"] if "pid" in shared else own), "--dev", "/dev"]
    for place, most in memory.items():
        options += ["--size", str(most), "--tmpfs", place]
    options += ["--dir", folder]
    for outside, inside in code_folders():
        options += ["--ro-bind", outside, inside]
    for target, place in interpreter_links():
        options += ["--symlink", target, place]
    return [*options, *shown, "--remount-ro", "/", "--cap-drop", "ALL"]


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={},
        cwd="/",
        timeout=_START_SECONDS,
        check=False,
    )


def _process_one(info: int) -> int:
    """pidfd of the namespace's first process: its end is the end of all inside."""
    text = b""
    while b"}" not in text:
        poller = select.poll()
        poller.register(info, select.POLLIN)
        if not poller.poll(_START_SECONDS * 1000):
            raise SandboxError("no answer in time")
        part = os.read(info, 4096)
        if not part:
            raise SandboxError("it ended at once")
        text += part
    try:
        return os.pidfd_open(int(json.loads(text)["child-pid"]))
    except OSError as error:
        raise SandboxError(str(error)) from error


def _last_words(output: int) -> str:
    os.set_blocking(output, False)
    with contextlib.suppress(OSError):
        return os.read(output, 500).decode("utf-8", "replace").strip()
    return ""
