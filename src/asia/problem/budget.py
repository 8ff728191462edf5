"""Budget of a search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

# Not from pydantic, which is too heavy for a worker.
from annotated_types import Ge, Gt

LEAST_MEMORY_MB = 1600


@dataclass(frozen=True)
class Budget:
    """Limits on the experiments, time, memory and tokens of a search."""

    experiments: Annotated[int, Ge(1)] = 15
    """Candidates to evaluate, the baseline included."""
    fit_seconds: Annotated[float, Gt(0)] = 120.0
    """Seconds that the fit of one fold may take."""
    memory_mb: Annotated[int, Ge(LEAST_MEMORY_MB)] = 4096
    patience: Annotated[int, Ge(1)] = 10
    """Experiments in the refine phase without a better model before the search counts as
    saturated."""
    retests: Annotated[int, Ge(0)] = 2
    """The most fits from other seeds of a candidate about to be kept; with 0, and where V is far
    above that of the linear reference, its first fit decides."""
    hours: Annotated[float, Gt(0)] | None = None
    """Hours of evaluation after which no experiment starts; None is open."""
