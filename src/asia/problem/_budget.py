"""What a search may spend."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """What a search may spend. `patience`: experiments in the refine phase without a better
    model before it counts as saturated; `hours`: wall clock, None is open."""

    experiments: int = 15
    fit_seconds: float = 120.0
    memory_mb: int = 4096
    patience: int = 10
    hours: float | None = None
