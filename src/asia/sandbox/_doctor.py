"""What this machine can do to keep candidates in, why not more, and how to get it."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from asia.sandbox._open import absent_layers, known_levels, why_not
from asia.sandbox._types import LAYERS, Isolation, Layer
from asia.sandbox.walls import landlock

_APPARMOR = Path("/proc/sys/kernel/apparmor_restrict_unprivileged_userns")
_CLONE = Path("/proc/sys/kernel/unprivileged_userns_clone")
_MOST = Path("/proc/sys/user/max_user_namespaces")
_CONTAINERS = (Path("/.dockerenv"), Path("/run/.containerenv"))


@dataclass(frozen=True)
class Machine:
    """Facts that decide about isolation. `landlock` is the kernel's version of it, 0 for none;
    `bubblewrap` where the program lies; memory_mb None where it cannot be told."""

    system: str
    architecture: str
    python: str
    cores: int
    memory_mb: int | None
    user: str
    container: bool
    landlock: int
    bubblewrap: str | None


@dataclass(frozen=True)
class Lack:
    """Something that does not work here: a level, or one layer of a level that works."""

    what: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class LevelState:
    """One level here; `layers` are those it would really have, none where it does not work."""

    level: Isolation
    works: bool
    layers: tuple[Layer, ...]
    lacks: tuple[Lack, ...]


def machine() -> Machine:
    """Facts of this machine."""
    return Machine(
        system=f"{platform.system()} {platform.release()}",
        architecture=platform.machine(),
        python=platform.python_version(),
        cores=os.cpu_count() or 1,
        memory_mb=_memory_mb(),
        user="root" if os.geteuid() == 0 else "ordinary",
        container=any(place.exists() for place in _CONTAINERS),
        landlock=_landlock_version(),
        bubblewrap=shutil.which("bwrap"),
    )


def survey() -> tuple[LevelState, ...]:
    """Every level tried out here, strongest first."""
    return tuple(_state(level) for level in known_levels())


def _state(level: Isolation) -> LevelState:
    reason = why_not(level)
    if reason is not None:
        return LevelState(level, False, (), (Lack(level.value, reason, _level_remedy(level)),))
    absent = absent_layers(level)
    lacks = tuple(Lack(layer.value, why, _layer_remedy(layer)) for layer, why in absent.items())
    return LevelState(level, True, tuple(x for x in LAYERS[level] if x not in absent), lacks)


def _level_remedy(level: Isolation) -> str:
    match level:
        case Isolation.NAMESPACE:
            return _namespace_remedy()
        case Isolation.LANDLOCK:
            absent = absent_layers(level)
            steps = [_layer_remedy(layer) for layer in absent]
            return "; ".join(steps) or "run a Python and a package that this user may read"
        case Isolation.SANDBOX_EXEC:
            return "use the sandbox-exec that macOS ships in /usr/bin"
        case Isolation.PROCESS:
            return "nothing to do: it works everywhere"


def _namespace_remedy() -> str:
    if sys.platform != "linux":
        return "use a Linux machine, or a Linux virtual machine on this one"
    if shutil.which("bwrap") is None:
        return (
            "install bubblewrap: apt install bubblewrap (Debian, Ubuntu), dnf install bubblewrap "
            "(Fedora, RHEL), pacman -S bubblewrap (Arch)"
        )
    if _number(_APPARMOR) == 1:
        return (
            "this system keeps user namespaces from programs without an AppArmor profile: give "
            "bwrap one that holds the rule `userns,` (docs/isolation.md has it)"
        )
    if _number(_CLONE) == 0:
        return "as root: sysctl -w kernel.unprivileged_userns_clone=1"
    if _number(_MOST) == 0:
        return "as root: sysctl -w user.max_user_namespaces=15000"
    if any(place.exists() for place in _CONTAINERS):
        return (
            "this is a container, which keeps namespaces to itself: use level landlock, or start "
            "the container with a seccomp profile that allows user namespaces"
        )
    return "use bubblewrap 0.8 or newer, and a system where `bwrap --unshare-user true` works"


def _layer_remedy(layer: Layer) -> str:
    if layer is Layer.SECCOMP:
        return "use a kernel with seccomp, on x86-64 or aarch64"
    if sys.platform != "linux":
        return "use a Linux machine, or a Linux virtual machine on this one"
    reason = landlock.why_not() or ""
    if "boot" in reason:
        return (
            "add landlock to the boot parameter lsm= (what it holds now: /sys/kernel/security/lsm)"
        )
    if "refused" in reason:
        return "allow the landlock_ system calls in the container's seccomp profile"
    return "use Linux 5.13 or newer, built with Landlock"


def _landlock_version() -> int:
    if sys.platform != "linux":
        return 0
    try:
        return landlock.abi()
    except OSError:
        return 0


def _memory_mb() -> int | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // (1024 * 1024)
    except (ValueError, OSError):
        return None


def _number(place: Path) -> int | None:
    try:
        return int(place.read_text())
    except (OSError, ValueError):
        return None
