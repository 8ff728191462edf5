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
_ETC = ("ld.so.cache", "localtime", "alternatives", "ssl/certs", "ssl/openssl.cnf",
        "ca-certificates", "pki/tls/certs", "pki/ca-trust", "crypto-policies")  # fmt: skip
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
_NET = ("resolv.conf", "hosts", "nsswitch.conf", "services", "protocols", "gai.conf")


@dataclass(frozen=True)
class Jail:
    """workspace: folder the agent writes in; socket: folder that holds the search's socket; mounts:
    shown read-only at their own places; configs: folders of the agent, writable, below its home;
    network: whether it has the machine's. Numbers of processes and sizes of files are bounded."""

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
        options += ["--size", str(_SHM_BYTES), "--tmpfs", "/dev/shm"]
        for place in ("/tmp", _HOME):
            options += ["--size", str(_TMPFS_BYTES), "--tmpfs", place]
        options += ["--dir", SOCKET_FOLDER]
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
        limited = [interpreter(), "-I", "-S", "-c", _LIMITED]
        return [bwrap, *options, "--", *limited, *arguments]

    def find(self, program: str) -> str | None:
        """Path of a program that can be run inside, None where there is none."""
        path = shutil.which(program, path=_programs(self.mounts))
        shown = ["/usr", *(os.path.realpath(p) for p in self.mounts)]
        shown += [outside for outside, _ in code_folders()]
        real = os.path.realpath(path) if path else ""
        return path if any(real == s or real.startswith(s + os.sep) for s in shown) else None


def _programs(mounts: tuple[Path, ...]) -> str:
    """Where programs are looked for inside: what is mounted goes before the machine's own."""
    places = [str(Path(interpreter()).parent)]
    for path in mounts:
        places += [str(p) for p in (path / "bin", path) if p.is_dir()]
    return os.pathsep.join((*places, "/usr/local/bin:/usr/bin:/bin"))


def jail_environment(mounts: tuple[Path, ...] = ()) -> dict[str, str]:
    """All environment variables inside, but those that the person passes on. Given to the process
    and not on the command line, where others could read a key."""
    return {
        "PATH": _programs(mounts),
        "HOME": _HOME,
        "USER": "agent",
        "LANG": "C.UTF-8",
        "TMPDIR": "/tmp",
    }
