"""Moves on equations whose states are all measured: learned terms and the network beside them."""

from __future__ import annotations

from asia.agents.expert.evidence import coloured, overfit
from asia.agents.expert.move import Case, Move
from asia.agents.library.cost import with_network
from asia.agents.library.recipe import Recipe

NET = ("physics_net",)
_MOST_WINDOWS = 960


def _alone(case: Case) -> Recipe:
    """The equations and their linear terms, by Levenberg-Marquardt."""
    config = {**dict(case.recipe.config), "linear": True}
    network = ("network", "hidden", "layers", "size")
    kept = tuple((k, v) for k, v in config.items() if k not in network)
    return Recipe("physics_net", kept, "LevenbergMarquardt", (("iterations", 15),))


def _watched(case: Case) -> bool:
    """Whether a fit may see its validation score, and stops a network by it."""
    return case.facts.early_stopping == "validation"


PHYSICS_NET_MOVES: tuple[Move, ...] = (
    Move(
        name="more windows",
        families=NET,
        weight=lambda c: 0.75 * (c.recipe.number("windows", 240) < _MOST_WINDOWS),
        change=lambda c: c.recipe.configured(windows=round(2 * c.recipe.number("windows", 240))),
        hypothesis="The equations were fitted to some of the training windows: more of them leave "
        "less to chance.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="equations alone",
        families=NET,
        weight=lambda c: 0.6 * bool(c.recipe.get("network")),
        change=_alone,
        hypothesis="The equations with a few sparse linear terms may hold all there is: what a "
        "network adds beyond them may be its own fold's noise.",
        expected="A higher training error; V near or below the network's.",
    ),
    Move(
        name="slow disturbance",
        families=NET,
        weight=lambda c: 0 if c.recipe.get("disturbance") else 0.5 if coloured(c.trial) else 0.35,
        change=lambda c: c.recipe.configured(disturbance=True),
        hypothesis="Something slow that no input shows acts on the states (wind, a draining "
        "supply, a drift).",
        expected="A whiter residual late in the window.",
    ),
    Move(
        name="feed-forward residual",
        families=NET,
        weight=lambda c: (0.7 if _watched(c) else 0.4) * (c.recipe.get("network") != "mlp"),
        change=lambda c: with_network(c.facts, c.recipe, "mlp"),
        hypothesis="What is left depends on the present states and inputs.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="recurrent residual",
        families=NET,
        weight=lambda c: (
            (0.8 if _watched(c) else 0.45) * (c.recipe.get("network") not in ("gru", "lstm"))
        ),
        change=lambda c: with_network(c.facts, c.recipe, "gru"),
        hypothesis="What is left depends on the past as well: delays of actuators, flows that lag.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="smaller residual",
        families=NET,
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
        families=NET,
        weight=lambda c: (0.5 if overfit(c.trial) > 1.5 else 0.3) * bool(c.recipe.get("linear")),
        change=lambda c: c.recipe.times("sparsity", 3.0, 3e-4),
        hypothesis="Terms that bring little on the training side bring harm elsewhere.",
        expected="About the same training error and a lower V.",
    ),
    Move(
        name="more linear terms",
        families=NET,
        weight=lambda c: 0.3 * bool(c.recipe.get("linear")),
        change=lambda c: c.recipe.times("sparsity", 0.3, 3e-4),
        hypothesis="Terms were dropped that the equations need.",
        expected="A lower training error, V follows.",
    ),
    Move(
        name="loss on every error alike",
        families=NET,
        weight=lambda c: 0.25 * (c.recipe.get("robust", 0.3) is not None),
        change=lambda c: c.recipe.configured(robust=None),
        hypothesis="Large errors are not outliers but what the equations have still to learn.",
        expected="A lower error at the end of the window.",
    ),
)
