"""Print a fitted model for other programs: one lowering, one printer for each target."""

from asia.export._export import Exported, Ready, export, lowered_run, write
from asia.export._model import ExportModel, Printed, TrainingWindow
from asia.export._parity import ParityRow
from asia.export._registry import TARGETS, find_target, target_names
from asia.export._target import Answers, Target
from asia.export._usage import table

__all__ = [
    "TARGETS",
    "Answers",
    "ExportModel",
    "Exported",
    "ParityRow",
    "Printed",
    "Ready",
    "Target",
    "TrainingWindow",
    "export",
    "find_target",
    "lowered_run",
    "table",
    "target_names",
    "write",
]
