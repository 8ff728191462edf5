"""Settings of the network methods that suit a problem and what a fit may cost.

The cost is reckoned from sizes and two constants of an ordinary core, never measured: the same
problem gives the same candidates everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from asia.agents._view import AgentView, Facts
from asia.agents.library.recipe import Recipe, Settings, read_recipe
from asia.agents.library.space import Choice, Parameter, Space, Span

Cost = Literal["light", "medium", "heavy"]
Stage = Literal["trial", "full"]

# Seconds, forward and backward: of one sample in a batch by cost, and of one step in time.
_SAMPLE: dict[Cost, float] = {"light": 6e-7, "medium": 2e-6, "heavy": 4e-6}
_TICK = 5e-6
# Share of the time a fit may take, most seconds, most updates.
_EFFORT: dict[Stage, tuple[float, float, int]] = {
    "trial": (0.1, 12.0, 2500),
    "full": (0.4, 60.0, 8000),
}
FEWEST_STEPS = 200
GENTLE_STEPS = 400
_BATCH = 128
_CHUNK = 128
LARGE_BATCH = 384
# So many samples are too many for batches of 128 to give a quiet gradient.
MANY_SAMPLES = 20_000
# Samples at the start of a simulation that a wrong initial state may spoil.
TRANSIENT = 20
# Windows at least so long are worth a loss at several horizons.
LEAST_HORIZON = 10
# The paper's early stopping: a check every 25 updates, 20 without improvement.
_EVERY, _PATIENCE = 25, 20


def steps(facts: Facts, cost: Cost, stage: Stage) -> int:
    """Updates that a fit of this cost may take."""
    share, most_seconds, most = _EFFORT[stage]
    seconds = min(share * facts.budget.fit_seconds, most_seconds)
    length = _length(facts)
    samples = min(facts.fit_samples, _BATCH * length)
    found = seconds / (samples * _SAMPLE[cost] + length * _TICK)
    return int(float(f"{max(FEWEST_STEPS, min(most, round(found))):.2g}"))


def adam(facts: Facts, cost: Cost, stage: Stage, learning_rate: float) -> Settings:
    """Settings of Adam: all windows in batches, or chunks of whole records; the metric as loss
    where it is the absolute error."""
    settings: Settings = (
        ("steps", steps(facts, cost, stage)),
        ("learning_rate", learning_rate),
        ("weight_decay", 1e-4),
    )
    if facts.horizon is None:
        settings = (*settings, ("truncation", _CHUNK))
    return (*settings, ("loss", "mae")) if facts.metric == "mae" else settings


def network_space(facts: Facts, cost: Cost, config: tuple[Parameter, ...]) -> Space:
    """A network's own parameters, functions of the inputs, and Adam's settings."""
    least, most = steps(facts, cost, "trial") // 2, steps(facts, cost, "full")
    options: tuple[Parameter, ...] = (
        Span("steps", least, most, whole=True),
        *adam_space(facts),
        Choice("members", (1, 3)),
    )
    return Space((*config, Choice("features", ((), ("square",)))), options)


def adam_space(facts: Facts, needs: str = "") -> tuple[Parameter, ...]:
    """Adam's settings but the number of steps."""
    found: list[Parameter] = [
        Span("learning_rate", 3e-4, 1e-2, needs=needs),
        Span("weight_decay", 1e-6, 1e-1, needs=needs),
        Choice("noise", (0.0, 0.05, 0.1), needs=needs),
        Choice("dropout", (0.0, 0.1), needs=needs),
        Choice("schedule", ("cosine", "plateau"), needs=needs),
        Choice("average", (0.0, 0.99), needs=needs),
        Choice("loss", ("mae" if facts.metric == "mae" else "mse", "huber"), needs=needs),
    ]
    if facts.early_stopping == "inner":
        found.append(Choice("holdout", (0.0, 0.2), needs=needs))
    if facts.fit_samples > MANY_SAMPLES:
        found.append(Choice("batch", (None, LARGE_BATCH), needs=needs))
    if facts.horizon is None:
        found.append(Choice("truncation", (64, 128, 256), needs=needs))
        found.append(Choice("carry", (False, True), needs="truncation"))
        found.append(Choice("washout", (0, TRANSIENT), needs=needs))
    elif facts.horizon >= LEAST_HORIZON:
        found.append(Choice("horizons", (None, several_horizons(facts)), needs=needs))
    return tuple(found)


def several_horizons(facts: Facts) -> tuple[int, ...]:
    """A tenth, a third and all of the window, in samples."""
    horizon = facts.horizon or 0
    return tuple(sorted({max(1, horizon // 10), max(1, horizon // 3), horizon}))


def by_lbfgs(facts: Facts, recipe: Recipe) -> Recipe:
    """The same model fitted by L-BFGS on all samples at once."""
    loss = "huber" if facts.metric == "mae" else "mse"
    updates = max(FEWEST_STEPS, round(recipe.number("steps", 2000)) // 10)
    options: Settings = (("steps", updates), ("ridge", 1e-5), ("loss", loss))
    return Recipe(recipe.family, recipe.config, "LBFGS", options)


def by_multiple_shooting(facts: Facts, recipe: Recipe) -> Recipe:
    """The same model fitted by multiple shooting."""
    options: Settings = (
        ("steps", round(recipe.number("steps", 2000))),
        ("learning_rate", recipe.number("learning_rate", 3e-3)),
        ("length", 30 if facts.horizon is None else max(2, facts.horizon // 3)),
    )
    if facts.metric == "mae":
        options = (*options, ("loss", "mae"))
    return Recipe(recipe.family, recipe.config, "MultipleShooting", options)


def with_network(facts: Facts, recipe: Recipe, kind: str) -> Recipe:
    """A small network beside fitted equations, trained gently from there."""
    recipe = recipe.configured(network=kind, hidden=32, size=0.1)
    if recipe.method == "Adam":
        return recipe
    options: Settings = (
        ("steps", min(GENTLE_STEPS, steps(facts, "heavy", "full"))),
        ("learning_rate", 1e-3),
        ("weight_decay", 1e-2),
        ("batch", 64),
    )
    if facts.metric == "mae":
        options = (*options, ("loss", "mae"))
    return Recipe(recipe.family, recipe.config, "Adam", options)


METHODS: dict[str, Callable[[Facts, Recipe], Recipe]] = {
    "LBFGS": by_lbfgs,
    "MultipleShooting": by_multiple_shooting,
    "feed-forward residual": partial(with_network, kind="mlp"),
    "recurrent residual": partial(with_network, kind="gru"),
}


def under_protocol(recipe: Recipe, facts: Facts) -> Recipe:
    """With `early_stopping = "validation"` gradient methods stop by the held-out part, as the
    protocol allows; otherwise the recipe as it is."""
    if facts.early_stopping != "validation":
        return recipe
    if recipe.family == "physics_net" and recipe.method == "LevenbergMarquardt":
        return recipe.trained(stop="validation")
    if recipe.method not in ("Adam", "LBFGS", "MultipleShooting"):
        return recipe
    return recipe.trained(stop="validation", every=_EVERY, patience=_PATIENCE)


def is_new(view: AgentView, recipe: Recipe) -> bool:
    """Whether no trial has the configuration, in whatever order its settings stand."""
    recipe = under_protocol(recipe, view.facts)
    tried = (read_recipe(trial.source) for trial in view.trials)
    if any(other is not None and other.key == recipe.key for other in tried):
        return False
    return not view.is_known(recipe.source(""))


def _length(facts: Facts) -> int:
    return facts.horizon or _CHUNK
