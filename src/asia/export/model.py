"""A model as export targets receive it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Array, Intersample, Signal
from asia.lowering.program import LoweredModel


@dataclass(frozen=True)
class Band:
    """Half width of the output bands."""

    level: float
    """Nominal coverage: share of the measured outputs inside the band."""
    half_width: Array
    """(ny,) in physical units: the mean over the training windows."""


@dataclass(frozen=True)
class ExportModel:
    """Lowered model, with the facts that its users need."""

    name: str
    """Name of the run."""
    use: str
    """Name of the model in the run."""
    problem: str
    """Name of the problem."""
    lowered: LoweredModel
    """Lowered model, with inputs and outputs in physical units."""
    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    sampling_time: float
    """Sampling time in s."""
    input_range: Array
    """(nu, 2): least and greatest in the training records."""
    output_range: Array
    """(ny, 2): least and greatest in the training records."""
    example: SimulatedSegment | None = None
    """Short case with ASIA's simulation of it, for files that hold one."""
    bands: tuple[Band, ...] = ()
    """Bands of the simulated outputs."""
    notes: tuple[str, ...] = ()
    """Further notes, a sentence each."""
    between: tuple[Intersample, ...] = ()
    """Behaviour of each input between samples in the model with the most weight; () holds all."""

    def facts(self) -> dict[str, Any]:
        """Facts as numbers and texts, for a file next to every target."""
        return {
            "run": self.name,
            "problem": self.problem,
            "model": self.use,
            "sampling_time": self.sampling_time,
            "intersample": list(self.between or ("zero",) * len(self.inputs)),
            "inputs": _facts(self.inputs, self.input_range),
            "outputs": _facts(self.outputs, self.output_range),
            "past_inputs": self.lowered.n_past_u,
            "past_outputs": self.lowered.n_past_y,
            "states": sum(map(math.prod, self.lowered.states)),
            "single_precision": self.lowered.single,
            "bands": [{"level": b.level, "half_width": b.half_width.tolist()} for b in self.bands],
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class Printed:
    """Files of a printer."""

    files: dict[str, bytes]
    """Contents by file name."""
    sizes: dict[str, int] = field(default_factory=dict[str, int])
    """Further sizes in bytes, by name."""

    @property
    def bytes(self) -> int:
        """Total size of all files."""
        return sum(len(data) for data in self.files.values())


def _facts(signals: tuple[Signal, ...], span: Array) -> list[dict[str, Any]]:
    rows = zip(signals, span.tolist(), strict=True)
    return [{"name": s.name, "unit": s.unit, "min": low, "max": high} for s, (low, high) in rows]
