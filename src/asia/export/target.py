"""The interface of an export target."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from asia.data.trajectory import Array
from asia.export.model import ExportModel, Printed, TrainingWindow


def missing_package(*names: str) -> str | None:
    """Instruction for `Target.missing` if one of these packages is not installed."""
    found = all(importlib.util.find_spec(name) for name in names)
    return None if found else "pip install '.[export]' in a clone of ASIA"


@dataclass(frozen=True)
class Answers:
    """Simulations of the training windows by printed files."""

    variant: str
    """Name of the variant: "double", "float", or another one of the target."""
    y_hat: tuple[Array, ...]
    """Simulated outputs (H, ny) of each window."""
    seconds: float
    """Computing time of all samples together."""
    single: bool = False
    """The variant computes in single precision."""
    without: Mapping[str, bytes] = field(default_factory=dict[str, bytes])
    """Files that replace printed ones and refuse this variant, if it differs too much; empty if
    nothing is to be written then."""


class Target(Protocol):
    """A printer for one environment, which can also run the files that it printed.

    Conformance suite: `asia.testing.check_export_target`.
    """

    name: str
    """Name as in `--to`."""
    usage: str
    """Instructions for the files, some lines of Markdown."""

    def missing(self) -> str | None:
        """Requirement that is not installed, as a sentence; None if printing is possible."""
        ...

    def print(self, model: ExportModel) -> Printed:
        """Print the files. Raises UserError if this target cannot hold the model."""
        ...

    def run(self, folder: Path, windows: Sequence[TrainingWindow]) -> list[Answers] | str:
        """Simulate with the files in a folder, or return why they cannot be run here."""
        ...
