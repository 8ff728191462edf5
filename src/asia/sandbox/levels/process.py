"""Weakest level: a plain process with resource limits, under a supervisor that ends its child
processes.

It protects against accidents, not against malice: the candidate reads whatever the user can read.
"""

from __future__ import annotations

from collections.abc import Collection

from asia.sandbox._level import Level
from asia.sandbox._types import Isolation, Layer, Limits
from asia.sandbox.worker.kept import start_kept
from asia.sandbox.worker.process import WorkerProcess


class Process(Level):
    """A plain process."""

    isolation = Isolation.PROCESS
    layers = (Layer.RLIMITS,)
    confined = False

    def why_not(self) -> str | None:
        return None

    def remedy(self) -> str:
        return "nothing to do: it works everywhere"

    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        return start_kept(limits, layers, libraries)
