"""Isolation levels of this machine: what works, why not, and a worker at a level."""

import compileall
import os
import platform
import shutil
import sys
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass

from asia.errors import SandboxError
from asia.judge.sandbox.layers import landlock
from asia.judge.sandbox.layers.environment import in_container, layer_remedy, package_folder
from asia.judge.sandbox.layers.pids import PidsMechanism
from asia.judge.sandbox.level import Level
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation, Layer, Limits, Probe
from asia.judge.sandbox.worker.worker import Worker


def probe(wanted: Isolation | None = None) -> Probe:
    """The strongest level that works here, found by starting something at it, or the `wanted` one.

    Also byte-compiles this package where its folder can be written: workers write nothing, so each
    of them would compile it anew. Raises SandboxError where `wanted` does not work.
    """
    compileall.compile_dir(package_folder(), quiet=2)
    notes = [] if wanted is None else ["requested by the user"]
    for level in fitting_levels() if wanted is None else (LEVELS[wanted],):
        name, reason = level.isolation, level.why_not()
        if reason is None:
            notes += [f"{name} without {layer}: {why}" for layer, why in level.missing().items()]
            notes += [f"{name}: {level.caveat}"] if level.caveat else []
            return Probe(name, tuple(notes), layers_in_force(name))
        if wanted is not None:
            raise SandboxError(f"isolation level '{wanted}' cannot run here: {reason}")
        notes.append(f"{name}: {reason}")
    raise SandboxError("no isolation level works on this machine")


def fitting_levels() -> tuple[Level, ...]:
    """The levels worth a word on this system, strongest first."""
    return tuple(level for level in LEVELS.values() if level.fits)


def why_not(level: Isolation) -> str | None:
    """None if a worker can be started at `level` here, else the reason in plain words."""
    return LEVELS[level].why_not()


def layers_in_force(level: Isolation, without: Collection[Layer] = ()) -> tuple[Layer, ...]:
    """The layers that a worker at `level` has here, where these are left out."""
    absent = {*LEVELS[level].missing(), *without}
    return tuple(layer for layer in LEVELS[level].layers if layer not in absent)


def open_worker(
    level: Isolation,
    limits: Limits,
    *,
    libraries: Collection[str] = (),
    without: Collection[Layer] = frozenset(),
) -> Worker:
    """Start one fresh worker at `level`.

    Args:
        libraries: modules that it loads, inside the sandbox, before its first request
        without: layers to leave out, to show in an outer sandbox what each of them stops; no
            search uses it

    Raises:
        SandboxError: if the worker cannot be started
    """
    layers = layers_in_force(level, without)
    process = LEVELS[level].open(limits, layers, libraries)
    return Worker(process, limits, pids_mechanism(level) if Layer.PIDS in layers else None)


def pids_mechanism(level: Isolation) -> PidsMechanism:
    """Return the mechanism that limits threads and processes of a worker at a level here."""
    return LEVELS[level].pids_mechanism()


# Isolation levels that this machine supports, the missing layers and their remedies.


@dataclass(frozen=True)
class Machine:
    """Facts that decide about isolation."""

    system: str
    """The kernel's name and release."""
    architecture: str
    python: str
    cores: int
    memory_mb: int | None
    """Physical memory, None where the system does not say."""
    user: str
    """`root` or `ordinary`."""
    container: bool
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
    remedy: str


@dataclass(frozen=True)
class LevelState:
    """One level, tried out here."""

    level: Isolation
    works: bool
    layers: tuple[Layer, ...]
    """Those it would really have, none where it does not work."""
    lacks: tuple[Lack, ...]
    """Missing parts that keep the level from working or from being complete."""
    pids: PidsMechanism | None
    """Mechanism that limits threads and processes of a worker; None where nothing does."""


def machine() -> Machine:
    """Facts of this machine."""
    memory_mb = None
    with suppress(ValueError, OSError):
        memory_mb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // (1024 * 1024)
    landlock_version = 0
    with suppress(OSError):
        landlock_version = landlock.abi() if sys.platform == "linux" else 0
    return Machine(
        system=f"{platform.system()} {platform.release()}",
        architecture=platform.machine(),
        python=platform.python_version(),
        cores=os.cpu_count() or 1,
        memory_mb=memory_mb,
        user="root" if os.geteuid() == 0 else "ordinary",
        container=in_container(),
        landlock=landlock_version,
        bubblewrap=shutil.which("bwrap"),
    )


def survey() -> tuple[LevelState, ...]:
    """Every level tried out here, strongest first."""
    states: list[LevelState] = []
    for level in fitting_levels():
        name, reason = level.isolation, level.why_not()
        if reason is not None:
            lack = Lack(name.value, reason, level.remedy())
            states.append(LevelState(name, False, (), (lack,), None))
            continue
        absent = level.missing().items()
        lacks = tuple(Lack(layer.value, why, layer_remedy(layer)) for layer, why in absent)
        layers = layers_in_force(name)
        pids = level.pids_mechanism() if Layer.PIDS in layers else None
        states.append(LevelState(name, True, layers, lacks, pids))
    return tuple(states)
