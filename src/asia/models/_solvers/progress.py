"""What a fit tells while it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[float, float], None]
"""Takes the number of steps or iterations done and the loss, as `Context.log` does."""


def silent(step: float, loss: float) -> None:
    """Tells nothing: for fits inside a choice."""
    del step, loss
