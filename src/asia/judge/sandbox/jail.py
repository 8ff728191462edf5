"""Jail for an agent that runs as a command.

The agent sees a workspace, the search's socket, programs, and the folders that the user mounts: no
home, no ledger, no test data, and no network unless requested.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from asia.judge.sandbox.layers.bubblewrap import walls
from asia.judge.sandbox.layers.environment import code_folders, interpreter
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation

INSIDE = "/workspace"
SOCKET_FOLDER = "/run/asia"
_HOME = "/home/agent"
_ETC = ("ssl/certs", "ssl/openssl.cnf", "ca-certificates", "pki/tls/certs", "pki/ca-trust",
        "crypto-policies")  # fmt: skip
_TMPFS_BYTES = 2 * 1024**3
_SHM_BYTES = 256 * 1024**2
_FILE_BYTES = 1024**3
_PROCESSES = 512
# Address space stays open: the runtimes of the agents reserve far more than they use.
_LIMITED = (
    "import os, resource, sys\n"
    f"for what, most in (('NPROC', {_PROCESSES}), ('FSIZE', {_FILE_BYTES}), ('CORE', 0)):\n"
    "    resource.setrlimit(getattr(resource, 'RLIMIT_' + what), (most, most))\n"
    "os.execvp(sys.argv[1], sys.argv[1:])\n"
)
# For Ctrl-C and the shell's own jobs. The terminal is the jail's own.
_CONTROLLED = (
    "import contextlib, fcntl, os, termios\n"
    "with contextlib.suppress(OSError): os.setsid()\n"
    "with contextlib.suppress(OSError): fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
)
_NET = ("resolv.conf", "hosts", "nsswitch.conf", "services", "protocols", "gai.conf")


@dataclass(frozen=True)
class Jail:
    """Resources of an agent that runs as a command; the number of processes and the size of files
    are bounded."""

    workspace: Path
    socket: Path
    mounts: tuple[Path, ...] = ()
    """Paths mounted read-only, each at its own place."""
    configs: tuple[Path, ...] = ()
    """Folders of the agent, writable, below its home."""
    network: bool = False

    @staticmethod
    def why_not() -> str | None:
        """None if there can be a jail here, else the reason in plain words."""
        return LEVELS[Isolation.NAMESPACE].why_not()

    def command(self, arguments: list[str], *, terminal: bool = False) -> list[str]:
        """The command line that runs `arguments` inside.

        Args:
            terminal: with standard input as the terminal that controls them
        """
        memory = {"/dev/shm": _SHM_BYTES, "/tmp": _TMPFS_BYTES, _HOME: _TMPFS_BYTES}
        files = [f"/etc/{name}" for name in (*_ETC, *(_NET if self.network else ()))]
        shown = [word for path in self.mounts for word in ("--ro-bind", str(path), str(path))]
        for path in self.configs:
            shown += ["--bind", str(path), f"{_HOME}/{path.name}"]
        shown += ["--ro-bind", str(self.socket), SOCKET_FOLDER]
        shown += ["--bind", str(self.workspace), INSIDE, "--chdir", INSIDE]
        shared = ("net",) if self.network else ()
        options = walls(memory, SOCKET_FOLDER, shown, files=files, shared=shared)
        options += ["--uid", "1000", "--gid", "1000", "--hostname", "workspace"]
        first = (_CONTROLLED if terminal else "") + _LIMITED
        options += ["--", interpreter(), "-I", "-S", "-c", first]
        return [shutil.which("bwrap") or "bwrap", *options, *arguments]

    def find(self, program: str) -> str | None:
        """Path of a program that can be run inside, None where there is none."""
        path = shutil.which(program, path=_programs(self.mounts))
        shown = ["/usr", *(os.path.realpath(p) for p in self.mounts)]
        shown += [outside for outside, _ in code_folders()]
        real = os.path.realpath(path) if path else ""
        return path if any(real == s or real.startswith(s + os.sep) for s in shown) else None


def _programs(mounts: tuple[Path, ...]) -> str:
    places = [str(Path(interpreter()).parent)]
    for path in mounts:
        places += [str(p) for p in (path / "bin", path) if p.is_dir()]
    return os.pathsep.join((*places, "/usr/local/bin:/usr/bin:/bin"))


def jail_environment(mounts: tuple[Path, ...] = ()) -> dict[str, str]:
    """Return all environment variables inside, except those that the user passes on.

    They are given to the process and not on the command line, where others could read a key.
    """
    return {
        "PATH": _programs(mounts),
        "HOME": _HOME,
        "USER": "agent",
        "LANG": "C.UTF-8",
        "TMPDIR": "/tmp",
    }
