"""Weakest level: a plain process with resource limits, under a supervisor that ends its child
processes.

It protects against accidents, not against malice: the candidate reads whatever the user can read.
"""

from collections.abc import Collection

from asia.judge.sandbox.level import Level
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import WorkerProcess, start_kept


class Process(Level):
    """A plain process."""

    isolation = Isolation.PROCESS
    layers = (Layer.RLIMITS, Layer.PIDS)
    confined = False

    def why_not(self) -> str | None:
        return None

    def remedy(self) -> str:
        return "nothing to do: it works everywhere"

    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        return start_kept(limits, layers, libraries)
