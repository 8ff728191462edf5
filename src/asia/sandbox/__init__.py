"""Run untrusted candidates in worker processes. What comes back is bytes and is never parsed."""

from asia.sandbox._jail import INSIDE, SOCKET_FOLDER, Jail, jail_environment
from asia.sandbox._open import open_worker, probe
from asia.sandbox._types import FitReply, Isolation, Limits, Probe, ScoreModel, ScoreRefusedError
from asia.sandbox._worker import Worker

__all__ = [
    "INSIDE",
    "SOCKET_FOLDER",
    "FitReply",
    "Isolation",
    "Jail",
    "Limits",
    "Probe",
    "ScoreModel",
    "ScoreRefusedError",
    "Worker",
    "jail_environment",
    "open_worker",
    "probe",
]
