"""Settings of the network methods that suit a problem and what a fit may cost.

The cost is reckoned from sizes and two constants of an ordinary core, never measured: the same
problem gives the same candidates everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from asia.agents._recipe import Recipe, Settings, read_recipe
from asia.agents._space import Choice, Parameter, Space, Span
from asia.agents._view import AgentView, Facts

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
_FEWEST = 200
_GENTLE_STEPS = 400
_BATCH = 128
_CHUNK = 128
# The paper's early stopping: a check every 25 updates, 20 without improvement.
_EVERY, _PATIENCE = 25, 20


def steps(facts: Facts, cost: Cost, stage: Stage) -> int:
    """Updates that a fit of this cost may take."""
    share, most_seconds, most = _EFFORT[stage]
    seconds = min(share * facts.budget.fit_seconds, most_seconds)
    length = _length(facts)
    samples = min(facts.fit_samples, _BATCH * length)
    found = seconds / (samples * _SAMPLE[cost] + length * _TICK)
    return int(float(f"{max(_FEWEST, min(most, round(found))):.2g}"))


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
    options: tuple[Parameter, ...] = (
        Span("steps", steps(facts, cost, "trial") // 2, steps(facts, cost, "full"), whole=True),
        Span("learning_rate", 3e-4, 1e-2),
        Span("weight_decay", 1e-6, 1e-1),
        Choice("noise", (0.0, 0.05, 0.1)),
        Choice("dropout", (0.0, 0.1)),
        Choice("schedule", ("cosine", "plateau")),
        Choice("average", (0.0, 0.99)),
    )
    if facts.horizon is None:
        options = (*options, Choice("truncation", (64, 128, 256)))
    return Space((*config, Choice("features", ((), ("square",)))), options)


def by_lbfgs(facts: Facts, recipe: Recipe) -> Recipe:
    """The same model fitted by L-BFGS on all samples at once."""
    loss = "huber" if facts.metric == "mae" else "mse"
    updates = max(_FEWEST, round(recipe.number("steps", 2000)) // 10)
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
        ("steps", min(_GENTLE_STEPS, steps(facts, "heavy", "full"))),
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
