"""Run untrusted candidates in worker processes. What comes back is bytes and is never parsed."""

from asia.sandbox._open import open_worker, probe
from asia.sandbox._types import FitReply, Isolation, Limits, Probe, ScoreModel, ScoreRefusedError
from asia.sandbox._worker import Worker

__all__ = [
    "FitReply",
    "Isolation",
    "Limits",
    "Probe",
    "ScoreModel",
    "ScoreRefusedError",
    "Worker",
    "open_worker",
    "probe",
]
