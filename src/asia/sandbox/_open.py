"""Choice of the isolation level, and workers at a given one."""

from __future__ import annotations

import compileall
from collections.abc import Collection, Sequence

from asia.errors import SandboxError
from asia.sandbox._level import Level
from asia.sandbox._types import Isolation, Layer, Limits, Probe
from asia.sandbox.levels import LEVELS
from asia.sandbox.walls.surroundings import package_folder
from asia.sandbox.worker.worker import Worker


def probe(wanted: Isolation | None = None) -> Probe:
    """The strongest level that works here, found by starting something at it, or the `wanted` one.

    Also byte-compiles this package where its folder can be written: workers write nothing, so each
    of them would compile it anew.

    Raises:
        SandboxError: where `wanted` does not work
    """
    compileall.compile_dir(package_folder(), quiet=2)
    if wanted is not None:
        reason = why_not(wanted)
        if reason is not None:
            raise SandboxError(f"isolation level '{wanted}' cannot run here: {reason}")
        return _found(LEVELS[wanted], ("requested by the user",))
    notes: list[str] = []
    for level in fitting_levels():
        reason = level.why_not()
        if reason is None:
            return _found(level, notes)
        notes.append(f"{level.isolation}: {reason}")
    raise SandboxError("no isolation level works on this machine")


def _found(level: Level, notes: Sequence[str]) -> Probe:
    name, absent = level.isolation, level.missing()
    said = [f"{name} without {layer}: {why}" for layer, why in absent.items()]
    said += [f"{name}: {level.caveat}"] if level.caveat else []
    return Probe(name, (*notes, *said), layers_in_force(name))


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
    process = LEVELS[level].open(limits, layers_in_force(level, without), libraries)
    return Worker(process, limits)
