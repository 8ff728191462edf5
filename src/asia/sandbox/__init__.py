"""Sandboxed worker processes for untrusted candidates; their replies are bytes that are never
parsed."""

from asia.sandbox._doctor import Lack, LevelState, Machine, machine, survey
from asia.sandbox._gpu import DEVICES, chosen_gpu, gpu_here
from asia.sandbox._jail import INSIDE, SOCKET_FOLDER, Jail, jail_environment
from asia.sandbox._level import Level
from asia.sandbox._open import fitting_levels, layers_in_force, open_worker, probe, why_not
from asia.sandbox._ready import ReadyWorkers
from asia.sandbox._types import (
    FitReply,
    Isolation,
    Layer,
    Limits,
    Probe,
    ScoreModel,
    ScoreRefusedError,
    WorkerKilledError,
)
from asia.sandbox.levels import LEVELS
from asia.sandbox.walls.gpu import gpu_nodes, gpu_words
from asia.sandbox.walls.surroundings import REPEATABLE, shown_in
from asia.sandbox.worker.worker import Worker

__all__ = [
    "DEVICES",
    "INSIDE",
    "LEVELS",
    "REPEATABLE",
    "SOCKET_FOLDER",
    "FitReply",
    "Isolation",
    "Jail",
    "Lack",
    "Layer",
    "Level",
    "LevelState",
    "Limits",
    "Machine",
    "Probe",
    "ReadyWorkers",
    "ScoreModel",
    "ScoreRefusedError",
    "Worker",
    "WorkerKilledError",
    "chosen_gpu",
    "fitting_levels",
    "gpu_here",
    "gpu_nodes",
    "gpu_words",
    "jail_environment",
    "layers_in_force",
    "machine",
    "open_worker",
    "probe",
    "shown_in",
    "survey",
    "why_not",
]
