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


LAYERS = {
    Isolation.NAMESPACE: (Layer.NAMESPACES, Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS),
    Isolation.LANDLOCK: (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS),
    Isolation.SANDBOX_EXEC: (Layer.PROFILE, Layer.RLIMITS),
    Isolation.PROCESS: (Layer.RLIMITS,),
}


@dataclass(frozen=True)
class Probe:
    """The strongest level that works here, the layers really in force, and in plain words why not
    a stronger level, or all layers of this one."""

    level: Isolation
    notes: tuple[str, ...] = ()
    layers: tuple[Layer, ...] = ()


@dataclass(frozen=True)
class Limits:
    """What one worker may use.

    fit_seconds: wall clock for executing the source and fitting, the same again for loading a
    model; simulate_seconds: for each simulate request; memory_mb: address space of the worker
    process; model_mb: largest fitted model that is kept.
    """

    fit_seconds: float
    simulate_seconds: float
    memory_mb: int
    model_mb: int = 64


class WorkerKilledError(SandboxError):
    """Somebody else ended the worker; most often the kernel, when memory had run out."""


class ScoreRefusedError(Exception):
    """No score is given; the candidate gets a RuntimeError with these words."""


ScoreModel = Callable[[bytes, float], float]
"""(model as `Worker.dump` gives it, `time.monotonic()` value to answer by) -> its score. Raises
ScoreRefusedError, and CandidateError where the model makes the candidate fail."""


@dataclass(frozen=True)
class FitReply:
    """What a fit leaves behind beside the model, all of it the candidate's own word.

    curve: (n, 2) step and loss given to `context.log`, at most 2000 rows, may hold NaN; output:
    the first 64 KB of stdout and stderr; seconds: wall time of the `fit` call, measured outside.
    """

    curve: Array
    output: str
    seconds: float
