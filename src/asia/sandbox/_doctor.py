"""Isolation levels that this machine supports, the missing layers and their remedies."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from dataclasses import dataclass

from asia.sandbox._level import Level
from asia.sandbox._open import fitting_levels, layers_in_force
from asia.sandbox._types import Isolation, Layer
from asia.sandbox.walls import landlock
from asia.sandbox.walls.own_layers import layer_remedy
from asia.sandbox.walls.surroundings import in_container


@dataclass(frozen=True)
class Machine:
    """Facts that decide about isolation."""

    system: str
    """The kernel's name and release."""
    architecture: str
    """Architecture of the processor."""
    python: str
    """Version of the running one."""
    cores: int
    """Number of cores of the machine."""
    memory_mb: int | None
    """Physical memory, None where the system does not say."""
    user: str
    """`root` or `ordinary`."""
    container: bool
    """Whether this is a container."""
    landlock: int
    """The kernel's version of it, 0 for none."""
    bubblewrap: str | None
    """Path of the program."""


@dataclass(frozen=True)
class Lack:
    """Something that does not work here: a level, or one layer of a level that works."""

    what: str
    """The level or the layer."""
    reason: str
    """Reason why it does not work."""
    remedy: str
    """Remedy."""


@dataclass(frozen=True)
class LevelState:
    """One level, tried out here."""

    level: Isolation
    """The level."""
    works: bool
    """Whether a worker starts at it."""
    layers: tuple[Layer, ...]
    """Those it would really have, none where it does not work."""
    lacks: tuple[Lack, ...]
    """Missing parts that keep the level from working or from being complete."""


def machine() -> Machine:
    """Facts of this machine."""
    return Machine(
        system=f"{platform.system()} {platform.release()}",
        architecture=platform.machine(),
        python=platform.python_version(),
        cores=os.cpu_count() or 1,
        memory_mb=_memory_mb(),
        user="root" if os.geteuid() == 0 else "ordinary",
        container=in_container(),
        landlock=_landlock_version(),
        bubblewrap=shutil.which("bwrap"),
    )


def survey() -> tuple[LevelState, ...]:
    """Every level tried out here, strongest first."""
    return tuple(_state(level) for level in fitting_levels())


def _state(level: Level) -> LevelState:
    name, reason = level.isolation, level.why_not()
    if reason is not None:
        return LevelState(name, False, (), (Lack(name.value, reason, level.remedy()),))
    absent = level.missing().items()
    lacks = tuple(Lack(layer.value, why, layer_remedy(layer)) for layer, why in absent)
    return LevelState(name, True, layers_in_force(name), lacks)


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
