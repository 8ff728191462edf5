"""Environment of a worker: command line, variables, readable folders, and the layers that this
kernel offers.
"""

from __future__ import annotations

import os
import site
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import asia
from asia._plugins import plugin_packages
from asia.errors import SandboxError
from asia.judge.sandbox.layers import landlock, seccomp
from asia.judge.sandbox.types import Layer, Limits
from asia.problem.plant import units_folder

SYSTEM_FILES = ("/etc/ld.so.cache", "/etc/localtime", "/etc/alternatives")
_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"))
_SYSTEM_CODE = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64")
CPU_FACTS = "/proc/cpuinfo"
"""The one file of /proc that a worker reads: XLA chooses the arithmetic by it. Others count what
all processes do, or show the inode numbers of mappings, which come from one counter."""
_FACTS = (
    CPU_FACTS,
    *(f"/sys/devices/system/cpu/{name}" for name in ("online", "possible", "present")),
)


REPEATABLE = {
    "PYTHONHASHSEED": "0",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}
"""Environment variables with which a fit can be repeated: one thread, one hash seed. XLA sizes its
thread pools by NPROC; without it the last bits of a sum depend on the number of cores regardless
of XLA_FLAGS."""

COMPILED_ONCE = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
"""Environment variables of a process that stores compiled programs. Shorter ones are compiled again
in less time than they are loaded."""


def environment(home: str) -> dict[str, str]:
    """All environment variables of a worker."""
    return {
        "PATH": "/usr/bin:/bin",
        "HOME": home,
        "TMPDIR": home,
        "USER": "candidate",
        "LOGNAME": "candidate",
        "LANG": "C.UTF-8",
        "ASIA_UNITS": str(units_folder()),
        **REPEATABLE,
        **COMPILED_ONCE,
    }


def interpreter() -> str:
    """Path of the running Python, without `..`: a path with one exists in a sandbox only where all
    that lies before it does.

    Raises:
        SandboxError: where it cannot be known
    """
    if not sys.executable:
        raise SandboxError("the path of the Python interpreter is unknown; a worker cannot start")
    return _without_dots(sys.executable)


def package_folder() -> Path:
    """The folder `asia` that holds this package."""
    return Path(_without_dots(asia.__file__)).parent


def child_command(
    requests: int,
    replies: int,
    limits: Limits,
    layers: Collection[Layer],
    libraries: Collection[str] = (),
    pids: int = 0,
) -> list[str]:
    """Command line of a worker; `layers` are those it puts on itself, `libraries` those it loads
    before its first request, `pids` its limit by RLIMIT_NPROC, 0 for none.

    -P and -s rather than -I: the environment is ours, and -I would drop PYTHONHASHSEED with it.
    """
    script = package_folder() / "judge" / "sandbox" / "worker" / "child.py"
    folders, packages = _user_site(), [f"asia={package_folder()}"]
    packages += [f"{one.name}={place}" for one in plugin_packages() for place in one.places]
    words = [str(requests), str(replies), str(limits.memory_mb), str(pids), ",".join(layers)]
    for part in (sorted(libraries), folders, packages):
        words += [str(len(part)), *part]
    return [interpreter(), "-P", "-s", "-B", "-u", str(script), *words, *readable()]


def readable() -> list[str]:
    """Return all paths that a worker under Landlock may read: code, and files that libraries ask
    the system for."""
    code = [place for _, place in code_folders()]
    return [*_SYSTEM_CODE, *SYSTEM_FILES, *code, *_FACTS]


def shown_in(path: Path) -> str | None:
    """The folder through which every candidate and every agent can read `path`, None for none."""
    real = os.path.realpath(path)
    code = [outside for outside, _ in code_folders()]
    system = [os.path.realpath(place) for place in _SYSTEM_CODE]
    return next((f for f in (*system, *code) if _within(real, [f])), None)


def code_folders() -> list[tuple[str, str]]:
    """(place on this machine, place in the sandbox) of all code a worker reads outside /usr: the
    interpreter, the environment, this package, and the packages of parts, of which nothing that
    lies beside them."""
    wanted: list[str] = []
    for prefix in (sys.base_prefix, sys.prefix):
        wanted += [os.path.realpath(prefix), _without_dots(prefix)]
    wanted += [*_user_site(), str(package_folder())]
    wanted += [str(place) for package in plugin_packages() for place in package.places]
    wanted += [str(units_folder())] if units_folder().is_dir() else []
    folders: list[tuple[str, str]] = []
    for place in wanted:
        if not _within(place, ["/usr", *(inside for _, inside in folders)]):
            folders.append((os.path.realpath(place), place))
    return folders


def in_container() -> bool:
    """Return whether this is a container that shows one of the usual signs."""
    return any(place.exists() for place in _CONTAINERS)


def interpreter_links() -> list[tuple[str, str]]:
    """(target, place) of the symbolic links from the interpreter's path to its file that lie
    outside every folder of `code_folders`."""
    known = ["/usr", "/bin", *(inside for _, inside in code_folders())]
    links: list[tuple[str, str]] = []
    place = interpreter()
    while os.path.islink(place) and len(links) < 40:
        target = os.readlink(place)
        if not _within(place, known):
            links.append((target, place))
            known.append(place)
        place = _without_dots(os.path.join(os.path.dirname(place), target))
    return links


def _without_dots(path: str) -> str:
    """The absolute path without `..`, each of which leads up from where the links before it lead.
    Links behind the last one stay."""
    head, dots, tail = f"{os.path.join(os.getcwd(), path)}/".rpartition("/../")
    return os.path.normpath(os.path.join(os.path.realpath(f"{head}/..") if dots else head, tail))


def _user_site() -> list[str]:
    folder = site.getusersitepackages()
    return [_without_dots(folder)] if folder in sys.path and os.path.isdir(folder) else []


def _within(place: str, folders: list[str]) -> bool:
    return any(place == folder or place.startswith(folder + os.sep) for folder in folders)


# The layers that a worker puts on itself: whether this kernel gives them, and how to get them.

ANOTHER_SYSTEM = "use a Linux machine, or a Linux virtual machine on this one"


def missing_layers() -> dict[Layer, str]:
    """Return the layers that a worker cannot put on itself here, with reasons."""
    if sys.platform != "linux":
        return {
            Layer.LANDLOCK: "Landlock needs Linux",
            Layer.SECCOMP: "seccomp needs Linux",
            Layer.PIDS: "threads are counted on Linux alone",
        }
    reasons = {Layer.LANDLOCK: landlock.why_not(), Layer.SECCOMP: seccomp.why_not()}
    return {layer: reason for layer, reason in reasons.items() if reason is not None}


def layer_remedy(layer: Layer) -> str:
    """Describe how to get a missing layer."""
    if layer is Layer.SECCOMP:
        return "use a kernel with seccomp, on x86-64 or aarch64"
    if sys.platform != "linux" or layer is Layer.PIDS:
        return ANOTHER_SYSTEM
    reason = landlock.why_not() or ""
    if "boot" in reason:
        return "add landlock to the boot parameter lsm= (present value: /sys/kernel/security/lsm)"
    if "refused" in reason:
        return "allow the landlock_ system calls in the container's seccomp profile"
    return "use Linux 5.13 or newer, built with Landlock"


# Trial start of a program at a level.

START_SECONDS = 20.0
_LONGEST_LINE = 200


def run_trial(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a short program without an environment; both outputs come back as one text. Raises
    OSError, subprocess.TimeoutExpired."""
    return subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={},
        cwd="/",
        timeout=START_SECONDS,
        check=False,
    )


def last_line(trial: subprocess.CompletedProcess[str], silent: str) -> str:
    """Return the last line that the trial printed; `silent` where it printed nothing."""
    return (trial.stdout.strip().splitlines() or [silent])[-1][:_LONGEST_LINE]
