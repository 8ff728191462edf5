"""Command line of bubblewrap: the view of a program in its own namespaces."""

import os
from collections.abc import Collection, Mapping
from typing import Literal

from asia.judge.sandbox.layers.environment import (
    SYSTEM_FILES,
    code_folders,
    environment,
    interpreter_links,
)

Shared = Literal["net", "pid"]
_HOME = "/tmp/scratch"
_TMP_BYTES = 64 * 1024 * 1024
_SHM_BYTES = 16 * 1024 * 1024


def bubblewrap_options(
    tmp_bytes: int = _TMP_BYTES,
    *,
    shown: Collection[str] = (),
    shared: Collection[Shared] = (),
    nesting: bool = False,
) -> list[str]:
    """Return the bwrap options of a worker, up to the command.

    Args:
        shown, shared, nesting: as in `walls`; without nesting no process is shown below /proc
    """
    memory = {"/dev/shm": _SHM_BYTES, "/tmp": tmp_bytes}
    shown = [*shown, "--chdir", _HOME]
    options = walls(memory, _HOME, shown, shared=shared, nesting=nesting, processes=nesting)
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
    processes: bool = True,
) -> list[str]:
    """bwrap options that show code alone, read-only.

    Args:
        memory: bytes of each file system in memory
        folder: one to make
        shown: options after the code's
        files: of the system, where they exist
        shared: namespaces that stay the caller's, with its /proc
        nesting: whether more can be made
        processes: whether /proc shows the namespace's processes and the kernel's counters
    """
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
    if "pid" in shared:
        options += ["--bind", "/proc", "/proc"]
    elif processes:
        # A root of the host owns /proc/sys inside too: without the remount it could write there.
        options += ["--proc", "/proc", "--remount-ro", "/proc"]
    options += ["--dev", "/dev"]
    for place, most in memory.items():
        options += ["--size", str(most), "--tmpfs", place]
    options += ["--dir", folder]
    for outside, inside in code_folders():
        options += ["--ro-bind", outside, inside]
    for target, place in interpreter_links():
        options += ["--symlink", target, place]
    return [*options, *shown, "--remount-ro", "/", "--cap-drop", "ALL"]
