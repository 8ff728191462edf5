"""The interface of an export target, and the comparison of its files with the simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import LiteralString, Protocol

import numpy as np

from asia._plugins import is_installed
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, spread_of
from asia.export.model import ExportModel, Printed


def missing_package(*names: LiteralString) -> str | None:
    """Instruction for `Target.missing` if one of these packages is not installed."""
    found = all(is_installed(name) for name in names)
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
        """Requirement that is not installed, as a sentence; None if printing is possible, as it is
        without a requirement."""
        return None

    def print(self, model: ExportModel) -> Printed:
        """Print the files. Raises UserError if this target cannot hold the model."""
        ...

    def run(self, folder: Path, windows: Sequence[SimulatedSegment]) -> list[Answers] | str:
        """Simulate with the files in a folder, or return why they cannot be run here."""
        ...


DOUBLE, SINGLE = 1e-9, 1e-4
"""Largest allowed differences, relative to the spread of the measured output."""


@dataclass(frozen=True)
class ParityRow:
    """One row of the comparison table."""

    target: str
    """Target and variant."""
    difference: float | None
    """Largest |difference| of an output over the standard deviation of its measured values; None
    where the files could not be run here."""
    limit: float
    """Largest allowed difference."""
    microseconds: float | None
    """Computing time for each sample."""
    bytes: int
    """Size of the files."""
    note: str = ""
    """Reason for a missing difference, or a remark on the result."""

    @property
    def holds(self) -> bool:
        """The files may be written."""
        return self.difference is None or self.difference <= self.limit


def parity_row(
    target: str, answers: Answers, windows: Sequence[SimulatedSegment], single: bool, size: int
) -> ParityRow:
    """Compare the answers of printed files with ASIA's simulation.

    Args:
        target: name of the target.
        answers: simulations by the printed files.
        windows: training windows.
        single: whether the model itself computes in single precision.
        size: size of the files in bytes.
    """
    name = target if answers.variant == "double" else f"{target} {answers.variant}"
    samples = sum(len(w.u) for w in windows)
    limit = SINGLE if single or answers.single else DOUBLE
    found = difference(answers.y_hat, windows)
    return ParityRow(name, found, limit, 1e6 * answers.seconds / samples, size)


def difference(y_hat: Sequence[Array], windows: Sequence[SimulatedSegment]) -> float:
    """Largest relative difference over all windows and outputs; infinite where a value is no
    number."""
    spread = spread_of(np.concatenate([w.y for w in windows]))
    largest = np.abs(np.concatenate([w.y_hat for w in windows])).max(axis=0)
    spread = np.where(spread > 0, spread, np.where(largest > 0, largest, 1.0))
    worst = 0.0
    for y, window in zip(y_hat, windows, strict=True):
        if y.shape != window.y_hat.shape or not np.isfinite(y).all():
            return float("inf")
        worst = max(worst, float((np.abs(y - window.y_hat) / spread).max()))
    return worst
