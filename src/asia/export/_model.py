"""A model as the printers are given it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from asia.data import Array, Signal
from asia.lowering import LoweredModel


@dataclass(frozen=True)
class Band:
    """Half the width of the output bands."""

    level: float
    """Share of the measured outputs that they are meant to hold."""
    half_width: Array
    """(ny,) in physical units: the mean over the training windows."""


@dataclass(frozen=True)
class ExportModel:
    """A lowered model, and what whoever uses it must know."""

    name: str
    """Of the run."""
    use: str
    """Which of its models."""
    problem: str
    """Its problem."""
    lowered: LoweredModel
    """Inputs and outputs in physical units."""
    inputs: tuple[Signal, ...]
    """Names and units."""
    outputs: tuple[Signal, ...]
    """Names and units."""
    sampling_time: float
    """In s; inputs are held in between."""
    input_range: Array
    """(nu, 2): least and greatest in the training records."""
    output_range: Array
    """(ny, 2): the same of the outputs."""
    example: TrainingWindow | None = None
    """A short case and what ASIA says of it, for files that hold one."""
    bands: tuple[Band, ...] = ()
    """Of the simulated outputs."""
    notes: tuple[str, ...] = ()
    """What else is to be known, a sentence each."""

    def facts(self) -> dict[str, Any]:
        """As numbers and texts, for a file beside every target."""
        return {
            "run": self.name,
            "problem": self.problem,
            "model": self.use,
            "sampling_time": self.sampling_time,
            "hold": "zero order",
            "inputs": _facts(self.inputs, self.input_range),
            "outputs": _facts(self.outputs, self.output_range),
            "past_inputs": self.lowered.n_past_u,
            "past_outputs": self.lowered.n_past_y,
            "states": sum(_size(s) for s in self.lowered.states),
            "single_precision": self.lowered.single,
            "bands": [{"level": b.level, "half_width": b.half_width.tolist()} for b in self.bands],
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class TrainingWindow:
    """A case from the training records, and what ASIA's own simulation says of it."""

    past_u: Array
    """(n_past_u, nu)."""
    past_y: Array
    """(n_past_y, ny)."""
    u: Array
    """(H, nu)."""
    y_hat: Array
    """(H, ny)."""
    y: Array
    """(H, ny), as measured."""

    def first(self, samples: int) -> TrainingWindow:
        """No more than so many samples of it."""
        cut = slice(samples)
        return TrainingWindow(self.past_u, self.past_y, self.u[cut], self.y_hat[cut], self.y[cut])


@dataclass(frozen=True)
class Printed:
    """What a printer gives."""

    files: dict[str, bytes]
    """By name."""
    sizes: dict[str, int] = field(default_factory=dict[str, int])
    """What else is counted, in bytes, by its name."""

    @property
    def bytes(self) -> int:
        """Of all files."""
        return sum(len(data) for data in self.files.values())


def _facts(signals: tuple[Signal, ...], span: Array) -> list[dict[str, Any]]:
    rows = zip(signals, span.tolist(), strict=True)
    return [{"name": s.name, "unit": s.unit, "min": low, "max": high} for s, (low, high) in rows]


def _size(shape: tuple[int, ...]) -> int:
    total = 1
    for n in shape:
        total *= n
    return total
