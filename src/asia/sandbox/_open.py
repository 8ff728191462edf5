"""Which level works here, and a worker at a given one."""

from __future__ import annotations

import compileall

from asia.errors import SandboxError
from asia.sandbox import _namespace, _process
from asia.sandbox._surroundings import package_folder
from asia.sandbox._types import Isolation, Limits, Probe
from asia.sandbox._worker import Worker


def probe() -> Probe:
    """The strongest level that works here, found by starting something at it.

    Also byte-compiles this package where its folder can be written: workers write nothing, so each
    of them would compile it anew.
    """
    compileall.compile_dir(package_folder(), quiet=2)
    reason = _namespace.why_not()
    if reason is None:
        return Probe(Isolation.NAMESPACE)
    return Probe(
        Isolation.PROCESS,
        (
            f"namespace: {reason}",
            f"{Isolation.LANDLOCK}: not part of this release",
        ),
    )


def open_worker(level: Isolation, limits: Limits) -> Worker:
    """Start one fresh worker at `level`. Raises SandboxError if it cannot be started."""
    match level:
        case Isolation.NAMESPACE:
            cell = _namespace.open_cell(limits)
        case Isolation.PROCESS:
            cell = _process.open_cell(limits)
        case Isolation.LANDLOCK:
            raise SandboxError("isolation level 'landlock' is not part of this release")
    return Worker(cell, limits)
