"""Which level works here, and a worker at a given one."""

from __future__ import annotations

import compileall
import sys
from collections.abc import Collection, Sequence

from asia.errors import SandboxError
from asia.sandbox._types import LAYERS, Isolation, Layer, Limits, Probe
from asia.sandbox.levels import landlock, namespace, process, sandbox_exec
from asia.sandbox.walls.surroundings import package_folder
from asia.sandbox.worker.worker import Worker


def probe(wanted: Isolation | None = None) -> Probe:
    """The strongest level that works here, found by starting something at it, or the `wanted` one.

    Also byte-compiles this package where its folder can be written: workers write nothing, so each
    of them would compile it anew. Raises SandboxError where `wanted` does not work.
    """
    compileall.compile_dir(package_folder(), quiet=2)
    if wanted is not None:
        reason = why_not(wanted)
        if reason is not None:
            raise SandboxError(f"isolation level '{wanted}' cannot run here: {reason}")
        return _found(wanted, ("asked for by the user",))
    notes: list[str] = []
    for level in known_levels():
        reason = why_not(level)
        if reason is None:
            return _found(level, notes)
        notes.append(f"{level}: {reason}")
    raise AssertionError("the process level works everywhere")


def _found(level: Isolation, notes: Sequence[str]) -> Probe:
    absent = absent_layers(level)
    layers = tuple(layer for layer in LAYERS[level] if layer not in absent)
    said = [f"{level} without {layer}: {why}" for layer, why in absent.items()]
    if level is Isolation.SANDBOX_EXEC:
        said.append(f"{level}: written to its documentation, not tested")
    return Probe(level, (*notes, *said), layers)


def known_levels() -> tuple[Isolation, ...]:
    """The levels worth a word on this system, strongest first."""
    foreign = () if sys.platform == "darwin" else (Isolation.SANDBOX_EXEC,)
    return tuple(level for level in Isolation if level not in foreign)


def why_not(level: Isolation) -> str | None:
    """None if a worker can be started at `level` here, else the reason in plain words."""
    match level:
        case Isolation.NAMESPACE:
            return namespace.why_not()
        case Isolation.LANDLOCK:
            return landlock.why_not()
        case Isolation.SANDBOX_EXEC:
            return sandbox_exec.why_not()
        case Isolation.PROCESS:
            return None


def absent_layers(level: Isolation) -> dict[Layer, str]:
    """Layers of a level that works here which the kernel does not give, and why."""
    missing = landlock.missing()
    return {layer: why for layer, why in missing.items() if layer in LAYERS[level]}


def open_worker(
    level: Isolation, limits: Limits, *, without: Collection[Layer] = frozenset()
) -> Worker:
    """Start one fresh worker at `level`. Raises SandboxError if it cannot be started.

    `without` leaves out layers, to show in an outer sandbox what each of them stops. No search
    uses it.
    """
    absent = absent_layers(level)
    if level is Isolation.LANDLOCK and absent:
        raise SandboxError(
            f"isolation level '{level}' cannot run here: {'; '.join(absent.values())}"
        )
    layers = [layer for layer in LAYERS[level] if layer not in absent and layer not in without]
    match level:
        case Isolation.NAMESPACE:
            cell = namespace.open_cell(limits, layers)
        case Isolation.LANDLOCK:
            cell = landlock.open_cell(limits, layers)
        case Isolation.SANDBOX_EXEC:
            cell = sandbox_exec.open_cell(limits, layers)
        case Isolation.PROCESS:
            cell = process.open_cell(limits, layers)
    return Worker(cell, limits)
