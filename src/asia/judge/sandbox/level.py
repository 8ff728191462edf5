"""Interface of an isolation level."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import ClassVar

from asia.judge.sandbox.layers.environment import (
    interpreter,
    last_line,
    missing_layers,
    package_folder,
    run_trial,
)
from asia.judge.sandbox.layers.pids import PidsMechanism, cgroup_works
from asia.judge.sandbox.types import Isolation, Layer, Limits
from asia.judge.sandbox.worker.process import WorkerProcess


class Level(ABC):
    """A way to keep candidates in."""

    isolation: ClassVar[Isolation]
    layers: ClassVar[tuple[Layer, ...]]
    """Layers of the level where the kernel supports all."""
    confined: ClassVar[bool] = True
    """Whether it means to stop a candidate that wants out, and not accidents alone."""
    system: ClassVar[str | None] = None
    """The only `sys.platform` on which it is worth a word, None for every one."""
    caveat: ClassVar[str | None] = None
    """Warning for users of the level."""

    @property
    def fits(self) -> bool:
        """Whether it is worth a word on this system."""
        return self.system in (None, sys.platform)

    def missing(self) -> dict[Layer, str]:
        """Return the layers that the kernel does not support, with reasons."""
        return {layer: why for layer, why in missing_layers().items() if layer in self.layers}

    def pids_mechanism(self) -> PidsMechanism:
        """Return the mechanism that limits threads and processes of a worker here."""
        return PidsMechanism.CGROUP if cgroup_works() else PidsMechanism.WATCHER

    @abstractmethod
    def why_not(self) -> str | None:
        """None if a worker can be started here, else the reason in plain words."""

    def trial(self, before: Sequence[str] = ()) -> str | None:
        """None if a process can put the layers on itself here and they stop what they must, else
        the reason. before: words in front of its command line. Raises OSError, TimeoutExpired."""
        layers = ",".join(layer for layer in self.layers if layer not in self.missing())
        script = package_folder() / "judge" / "sandbox" / "layers" / "lockdown.py"
        python = [interpreter(), "-I", "-S", "-B", str(script), layers, str(package_folder())]
        found = run_trial([*before, *python])
        return None if found.returncode == 0 else last_line(found, "a trial failed silently")

    @abstractmethod
    def remedy(self) -> str:
        """Describe the remedy where the level does not work."""

    @abstractmethod
    def open(
        self, limits: Limits, layers: Collection[Layer], libraries: Collection[str]
    ) -> WorkerProcess:
        """Start a worker behind these layers that loads these libraries ahead. Raises
        SandboxError."""
