"""The interface of an export target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from asia.data import Array
from asia.export._model import ExportModel, Printed, TrainingWindow


@dataclass(frozen=True)
class Answers:
    """Simulations of the training windows by printed files."""

    variant: str
    """"double", "float", or what else there is more than one of."""
    y_hat: tuple[Array, ...]
    """(H, ny) of each window."""
    seconds: float
    """For all samples together."""
    single: bool = False
    """Whether it computes in single precision."""
    without: Mapping[str, bytes] = field(default_factory=dict[str, bytes])
    """Files that take the place of printed ones where this variant differs too much, and refuse it;
    empty where nothing is to be written then."""


class Target(Protocol):
    """A printer for one environment, which can also run the files that it printed.

    Conformance suite: `asia.testing.check_export_target`.
    """

    name: str
    """As in `--to`."""
    usage: str
    """How to use the files, some lines of Markdown."""

    def missing(self) -> str | None:
        """What must be installed to print, as a sentence; None where nothing is."""
        ...

    def print(self, model: ExportModel) -> Printed:
        """The files. Raises UserError where this target cannot hold the model."""
        ...

    def run(self, folder: Path, windows: Sequence[TrainingWindow]) -> list[Answers] | str:
        """Simulations by the files in a folder, or why they cannot be run here."""
        ...
