"""Print a fitted model for other programs: one lowering, one printer for each target."""

from asia.export._export import Exported, Ready, export, lowered_run, write
from asia.export._model import ExportModel, Printed, TrainingWindow
from asia.export._parity import ParityRow
from asia.export._registry import TARGETS
from asia.export._usage import table

__all__ = [
    "TARGETS",
    "ExportModel",
    "Exported",
    "ParityRow",
    "Printed",
    "Ready",
    "TrainingWindow",
    "export",
    "lowered_run",
    "table",
    "write",
]
