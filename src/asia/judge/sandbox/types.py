"""Types that pass between the sandbox and its callers."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from asia.errors import SandboxError


class Isolation(StrEnum):
    """Isolation level, strongest first."""

    NAMESPACE = "namespace"
    LANDLOCK = "landlock"
    SANDBOX_EXEC = "sandbox-exec"
    PROCESS = "process"


class Layer(StrEnum):
    """Layer of an isolation level."""

    NAMESPACES = "namespaces"
    LANDLOCK = "landlock"
    SECCOMP = "seccomp"
    PROFILE = "profile"
    RLIMITS = "rlimits"
    PIDS = "pids"


@dataclass(frozen=True)
class Probe:
    """The strongest level that works here."""

    level: Isolation
    notes: tuple[str, ...] = ()
    """Reasons in plain words for a weaker level, or for missing layers of this one."""
    layers: tuple[Layer, ...] = ()
    """The layers really in force."""


@dataclass(frozen=True)
class Limits:
    """Resource limits of one worker."""

    fit_seconds: float
    """Wall clock for executing the source and fitting; the same again for loading a model."""
    simulate_seconds: float
    """Wall clock for each simulate request."""
    memory_mb: int
    """Address space of the worker process."""
    model_mb: int = 64
    """Largest fitted model that is kept."""


class WorkerKilledError(SandboxError):
    """Error for a worker ended by another process; most often by the kernel without memory."""


class ScoreRefusedError(Exception):
    """Refusal of a score; the candidate gets a RuntimeError with this text."""


ScoreModel = Callable[[bytes, float], float]
"""Function of a model, as `Worker.dump` gives it, and a deadline (`time.monotonic()`) that returns
its score.

Raises:
    ScoreRefusedError: when no score is given
    CandidateError: where the model makes the candidate fail
"""
