"""Cost of a fit: number of updates of a network, and expected seconds of a recipe.

Both are estimated from sizes and from constants of an ordinary core, never from a clock: the same
problem gives the same candidates everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.agents.library.recipe import Recipe
from asia.agents.view import Facts

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
_USUAL_SIZE = 16.0


@dataclass(frozen=True)
class Timing:
    """Seconds of one fold's fit on an ordinary core, see `fit_seconds`. Fitted to recorded searches
    by `benchmarks/models/cost.py`."""

    start: float = 2.0
    """Seconds of every fit for imports, tracing and compilation."""
    unit: float = 1e-6
    """Seconds for each simulated sample at the usual size of a model."""


def fit_seconds(timing: Timing, facts: Facts, recipe: Recipe) -> float:
    """Expected seconds of one fold's fit."""
    return timing.start + timing.unit * work(facts, recipe)


def work(facts: Facts, recipe: Recipe) -> float:
    """Samples that a fit simulates, all its steps and repetitions together, times the size of the
    model over the usual one; at least half of it counts whatever the size."""
    rounds = recipe.number("steps", 1.0) * recipe.number("iterations", 1.0)
    if recipe.get("noise_model") == "slow" and not recipe.has("steps"):
        # Fits of few parameters are repeated after each estimate of the noise model.
        rounds *= 2.0
    samples = float(facts.fit_samples)
    if recipe.method == "Adam":
        length = recipe.number("truncation", facts.horizon or facts.fit_samples)
        samples = min(samples, recipe.number("batch", _BATCH) * length)
    repeats = max(1.0, recipe.number("starts", 1.0)) * max(1.0, recipe.number("members", 1.0))
    sizes = ("hidden", "width", "units", "states", "slow", "residual")
    size = max(recipe.number(name, 0.0) for name in sizes)
    return rounds * samples * repeats * (0.5 + 0.5 * (size or _USUAL_SIZE) / _USUAL_SIZE)


def steps(facts: Facts, cost: SampleCost, stage: Stage) -> int:
    """Updates that a fit of this cost may take."""
    share, most_seconds, most = _EFFORT[stage]
    seconds = min(share * facts.budget.fit_seconds, most_seconds)
    length = facts.horizon or CHUNK
    samples = min(facts.fit_samples, _BATCH * length)
    found = seconds / (samples * _SAMPLE[cost] + length * _TICK)
    return int(float(f"{max(FEWEST_STEPS, min(most, round(found))):.2g}"))
