"""The person's equations where all states are measured: learned terms and a network beside them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from asia.agents._view import Facts
from asia.agents.library.card import Card
from asia.agents.library.cost import GENTLE_STEPS, steps
from asia.agents.library.evidence import coloured, overfit
from asia.agents.library.family import Family
from asia.agents.library.methods import LM, absolute_loss, adam_space
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Arguments, Recipe
from asia.agents.library.space import OneOf, Space, Span

_MOST_WINDOWS = 960


def _physics_net(_: Facts) -> Recipe:
    config = (("linear", True), ("sparsity", 3e-4), ("robust", 0.3), ("windows", 240))
    return Recipe("physics_net", config, LM, (("iterations", 15),))


def _space(facts: Facts) -> Space:
    return Space(
        config=(
            OneOf("linear", (False, True)),
            OneOf("lag", (False, True)),
            OneOf("gain", (False, True)),
            OneOf("disturbance", (False, True)),
            Span("sparsity", 1e-5, 1e-2, needs="linear"),
            Span("ridge", 1e-4, 1e-1, needs="linear"),
            OneOf("robust", (None, 0.1, 0.3, 1.0)),
            OneOf("windows", (240, 480)),
            OneOf("hidden", (16, 32, 64), needs="network"),
            OneOf("layers", (1, 2), needs="network"),
            Span("size", 0.03, 1.0, needs="network"),
        ),
        options=(
            OneOf("iterations", (10, 15, 30)),
            Span("steps", GENTLE_STEPS // 2, 2 * GENTLE_STEPS, whole=True, needs="network"),
            *adam_space(facts, needs="network"),
        ),
    )


def _with_network(facts: Facts, recipe: Recipe, kind: str) -> Recipe:
    """A small network beside fitted equations, trained gently from there."""
    recipe = recipe.configured(network=kind, hidden=32, size=0.1)
    if recipe.method == "Adam":
        return recipe
    options: Arguments = (
        ("steps", min(GENTLE_STEPS, steps(facts, "heavy", "full"))),
        ("learning_rate", 1e-3),
        ("weight_decay", 1e-2),
        ("batch", 64),
        *absolute_loss(facts),
    )
    return recipe.fitted_by("Adam", options)


def _alone(at: Situation) -> Recipe:
    """The equations and their linear terms, by Levenberg-Marquardt."""
    config = {**dict(at.recipe.config), "linear": True}
    network = ("network", "hidden", "layers", "size")
    kept = tuple((k, v) for k, v in config.items() if k not in network)
    return replace(at.recipe, config=kept).fitted_by(LM, (("iterations", 15),))


def _watched(at: Situation) -> bool:
    """Whether a fit may see its validation score, and stops a network by it."""
    return at.facts.early_stopping == "validation"


_MOVES: tuple[Move, ...] = (
    Move(
        name="more windows",
        weight=lambda c: 0.75 * (c.recipe.number("windows", 240) < _MOST_WINDOWS),
        change=lambda c: c.recipe.configured(windows=round(2 * c.recipe.number("windows", 240))),
        hypothesis="The equations were fitted to some of the training windows: more of them leave "
        "less to chance.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="equations alone",
        weight=lambda c: 0.6 * bool(c.recipe.get("network")),
        change=_alone,
        hypothesis="The equations with a few sparse linear terms may hold all there is: what a "
        "network adds beyond them may be its own fold's noise.",
        expected="A higher training error; V near or below the network's.",
    ),
    Move(
        name="slow disturbance",
        weight=lambda c: 0 if c.recipe.get("disturbance") else 0.5 if coloured(c.trial) else 0.35,
        change=lambda c: c.recipe.configured(disturbance=True),
        hypothesis="Something slow that no input shows acts on the states (wind, a draining "
        "supply, a drift).",
        expected="A whiter residual late in the window.",
    ),
    Move(
        name="feed-forward residual",
        weight=lambda c: (0.7 if _watched(c) else 0.4) * (c.recipe.get("network") != "mlp"),
        change=lambda c: _with_network(c.facts, c.recipe, "mlp"),
        hypothesis="What is left depends on the present states and inputs.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="recurrent residual",
        weight=lambda c: (
            (0.8 if _watched(c) else 0.45) * (c.recipe.get("network") not in ("gru", "lstm"))
        ),
        change=lambda c: _with_network(c.facts, c.recipe, "gru"),
        hypothesis="What is left depends on the past as well: delays of actuators, flows that lag.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="smaller residual",
        weight=lambda c: (
            (0.6 if overfit(c.trial) > 1.5 else 0.3)
            * bool(c.recipe.get("network"))
            * (c.recipe.number("size", 1.0) > 0.1)
        ),
        change=lambda c: c.recipe.times("size", 0.3, 1.0),
        hypothesis="Held to a third of its reach, the network cannot outvote the equations where "
        "it has not been trained.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="fewer linear terms",
        weight=lambda c: (0.5 if overfit(c.trial) > 1.5 else 0.3) * bool(c.recipe.get("linear")),
        change=lambda c: c.recipe.times("sparsity", 3.0, 3e-4),
        hypothesis="Terms that bring little on the training side bring harm elsewhere.",
        expected="About the same training error and a lower V.",
    ),
    Move(
        name="more linear terms",
        weight=lambda c: 0.3 * bool(c.recipe.get("linear")),
        change=lambda c: c.recipe.times("sparsity", 0.3, 3e-4),
        hypothesis="Terms were dropped that the equations need.",
        expected="A lower training error, V follows.",
    ),
    Move(
        name="loss on every error alike",
        weight=lambda c: 0.25 * (c.recipe.get("robust", 0.3) is not None),
        change=lambda c: c.recipe.configured(robust=None),
        hypothesis="Large errors are not outliers but what the equations have still to learn.",
        expected="A lower error at the end of the window.",
    ),
)

CARD = Card(
    (
        Family(
            name="physics_net",
            label="physics network",
            use="equations whose states are all measured, with learned terms and a network beside "
            "them",
            base=8,
            points=(("windows", 3),),
            needs=frozenset({"physics", "measured"}),
            start=_physics_net,
            space=_space,
            small=(("iterations", 3),),
            methods=(partial(_with_network, kind="mlp"), partial(_with_network, kind="gru")),
            stopped_by_score=frozenset({LM}),
        ),
    ),
    _MOVES,
)
