"""What passes between the sandbox and its callers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from asia.data import Array
from asia.errors import SandboxError


class Isolation(StrEnum):
    """What keeps a candidate in, strongest first."""

    NAMESPACE = "namespace"
    LANDLOCK = "landlock"
    SANDBOX_EXEC = "sandbox-exec"
    PROCESS = "process"


class Layer(StrEnum):
    """What a level is made of."""

    NAMESPACES = "namespaces"
    LANDLOCK = "landlock"
    SECCOMP = "seccomp"
    PROFILE = "profile"
    RLIMITS = "rlimits"


@dataclass(frozen=True)
class Probe:
    """The strongest level that works here."""

    level: Isolation
    """The level."""
    notes: tuple[str, ...] = ()
    """In plain words why not a stronger level, or not all layers of this one."""
    layers: tuple[Layer, ...] = ()
    """The layers really in force."""


@dataclass(frozen=True)
class Limits:
    """What one worker may use."""

    fit_seconds: float
    """Wall clock for executing the source and fitting; the same again for loading a model."""
    simulate_seconds: float
    """Wall clock for each simulate request."""
    memory_mb: int
    """Address space of the worker process."""
    model_mb: int = 64
    """Largest fitted model that is kept."""
    gpu: bool = False
    """Whether it computes on the GPU. Then `memory_mb` is what it may have in memory: CUDA reserves
    far more addresses than it uses."""


class WorkerKilledError(SandboxError):
    """Somebody else ended the worker; most often the kernel, when memory had run out."""


class ScoreRefusedError(Exception):
    """No score is given; the candidate gets a RuntimeError with these words."""


ScoreModel = Callable[[bytes, float], float]
"""(model as `Worker.dump` gives it, `time.monotonic()` value to answer by) -> its score. Raises
ScoreRefusedError, and CandidateError where the model makes the candidate fail."""


@dataclass(frozen=True)
class FitReply:
    """What a fit leaves behind beside the model, all of it the candidate's own word."""

    curve: Array
    """(n, 2) step and loss given to `context.log`, at most 2000 rows, may hold NaN."""
    output: str
    """The first 64 KB of stdout and stderr."""
    seconds: float
    """Wall time of the `fit` call, measured outside."""
