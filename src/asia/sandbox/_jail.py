"""A jail for an agent that runs as a command: it sees a workspace, the search's socket, programs to
run, and what its person mounts. No home, no ledger, no test data, and no network unless asked."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from asia.sandbox._surroundings import code_folders, interpreter, interpreter_links

INSIDE = "/workspace"
SOCKET_FOLDER = "/run/asia"
_HOME = "/home/agent"
_ETC = ("ld.so.cache", "localtime", "alternatives", "ssl", "ca-certificates", "pki")
_NET = ("resolv.conf", "hosts", "nsswitch.conf", "services", "protocols", "gai.conf")


@dataclass(frozen=True)
class Jail:
    """workspace: folder the agent writes in; socket: folder that holds the search's socket; mounts:
    shown read-only at their own places; configs: folders of the agent, writable, below its home;
    network: whether it has the machine's."""

    workspace: Path
    socket: Path
    mounts: tuple[Path, ...] = ()
    configs: tuple[Path, ...] = ()
    network: bool = False

    def command(self, arguments: list[str]) -> list[str]:
        """The command line that runs `arguments` inside."""
        bwrap = shutil.which("bwrap") or "bwrap"
        options = [f"--unshare-{w}" for w in ("user", "ipc", "pid", "uts", "cgroup-try")]
        options += [] if self.network else ["--unshare-net"]
        options += ["--disable-userns", "--die-with-parent", "--new-session"]
        options += ["--ro-bind", "/usr", "/usr", "--dir", "/etc"]
        for name in ("/bin", "/sbin", "/lib", "/lib32", "/lib64"):
            if os.path.islink(name):
                options += ["--symlink", os.readlink(name), name]
            elif os.path.isdir(name):
                options += ["--ro-bind", name, name]
        for name in (*_ETC, *(_NET if self.network else ())):
            options += ["--ro-bind-try", f"/etc/{name}", f"/etc/{name}"]
        options += ["--proc", "/proc", "--remount-ro", "/proc", "--dev", "/dev"]
        options += ["--tmpfs", "/tmp", "--tmpfs", _HOME, "--dir", SOCKET_FOLDER]
        for outside, inside in code_folders():
            options += ["--ro-bind", outside, inside]
        for target, place in interpreter_links():
            options += ["--symlink", target, place]
        for path in self.mounts:
            options += ["--ro-bind", str(path), str(path)]
        for path in self.configs:
            options += ["--bind", str(path), f"{_HOME}/{path.name}"]
        options += ["--ro-bind", str(self.socket), SOCKET_FOLDER]
        options += ["--bind", str(self.workspace), INSIDE, "--chdir", INSIDE]
        options += ["--remount-ro", "/", "--cap-drop", "ALL"]
        options += ["--uid", "1000", "--gid", "1000", "--hostname", "workspace"]
        return [bwrap, *options, "--", *arguments]


def jail_environment() -> dict[str, str]:
    """All environment variables inside, but those that the person passes on. Given to the process
    and not on the command line, where others could read a key."""
    programs = os.pathsep.join((str(Path(interpreter()).parent), "/usr/local/bin:/usr/bin:/bin"))
    return {
        "PATH": programs,
        "HOME": _HOME,
        "USER": "agent",
        "LANG": "C.UTF-8",
        "TMPDIR": "/tmp",
    }
