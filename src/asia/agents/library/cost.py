"""What a fit of a network may cost, in updates.

The cost is estimated from sizes and two constants of an ordinary core, never measured: the same
problem gives the same candidates everywhere.
"""

from __future__ import annotations

from typing import Literal

from asia.agents._view import Facts

SampleCost = Literal["light", "medium", "heavy"]
Stage = Literal["trial", "full"]

# Seconds, forward and backward: of one sample in a batch by cost, and of one step in time.
_SAMPLE: dict[SampleCost, float] = {"light": 6e-7, "medium": 2e-6, "heavy": 4e-6}
_TICK = 5e-6
# Share of the time a fit may take, most seconds, most updates.
_EFFORT: dict[Stage, tuple[float, float, int]] = {
    "trial": (0.1, 12.0, 2500),
    "full": (0.4, 60.0, 8000),
}
FEWEST_STEPS = 200
GENTLE_STEPS = 400
CHUNK = 128
_BATCH = 128


def steps(facts: Facts, cost: SampleCost, stage: Stage) -> int:
    """Updates that a fit of this cost may take."""
    share, most_seconds, most = _EFFORT[stage]
    seconds = min(share * facts.budget.fit_seconds, most_seconds)
    length = facts.horizon or CHUNK
    samples = min(facts.fit_samples, _BATCH * length)
    found = seconds / (samples * _SAMPLE[cost] + length * _TICK)
    return int(float(f"{max(FEWEST_STEPS, min(most, round(found))):.2g}"))
