"""Families that start from the person's equations."""

from __future__ import annotations

from asia.agents._view import Facts
from asia.agents.library.cost import GENTLE_STEPS, adam_space
from asia.agents.library.family import Family
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import Choice, Space, Span

LM = "LevenbergMarquardt"


def state_sets(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """Single states and all of them together, for settings that name states."""
    states = facts.physics.states if facts.physics else ()
    single = tuple((s,) for s in states)
    return (*single, states) if len(states) > 1 else single


def output_offsets(facts: Facts) -> tuple[str, ...]:
    """Outputs that are not states by name, whose offsets would be confused."""
    states = facts.physics.states if facts.physics else ()
    return tuple(s.name for s in facts.outputs if s.name not in states)


def _offset_sets(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """None, those of the outputs, those of the states, and both."""
    outputs = output_offsets(facts)
    states = facts.physics.states if facts.physics else ()
    return tuple(dict.fromkeys(((), outputs, states, (*outputs, *states))))


def _greybox(facts: Facts) -> Recipe:
    """Over windows of measured states the equations need no search for a start."""
    config = (("ridge", 1e-3), ("residual_ridge", 1e-2))
    effort = (("iterations", 60), ("starts", 8))
    if facts.horizon is not None:
        effort = (("iterations", 15), ("starts", 2))
    return Recipe("greybox", config, LM, effort)


def _greybox_space(facts: Facts) -> Space:
    return Space(
        config=(
            Choice("saturation", ((), *state_sets(facts))),
            Choice("spill", (False, True), needs="saturation"),
            Choice("linear", (False, True)),
            Choice("offset", _offset_sets(facts)),
            Choice("input_delay", (0.0, 3.0)),
            Choice("robust", (None, 0.1)),
            Choice("residual", (0, 4)),
            Span("ridge", 1e-5, 1e-1),
            Span("residual_ridge", 1e-4, 1e-1, needs="residual"),
        ),
        options=(Choice("iterations", (40, 80)), Choice("starts", (4, 8, 16))),
    )


def _hybrid(_: Facts) -> Recipe:
    config = (("units", 4), ("ridge", 1e-2))
    return Recipe("hybrid", config, LM, (("iterations", 60), ("starts", 8)))


def _hybrid_space(_: Facts) -> Space:
    return Space(
        config=(Choice("units", (2, 4, 8)), Span("ridge", 1e-4, 1e-1)),
        options=(Choice("iterations", (40, 80)), Choice("starts", (4, 8))),
    )


def _physics_net(_: Facts) -> Recipe:
    config = (("linear", True), ("sparsity", 3e-4), ("robust", 0.3), ("windows", 240))
    return Recipe("physics_net", config, LM, (("iterations", 15),))


def _physics_net_space(facts: Facts) -> Space:
    return Space(
        config=(
            Choice("linear", (False, True)),
            Choice("lag", (False, True)),
            Choice("gain", (False, True)),
            Choice("disturbance", (False, True)),
            Span("sparsity", 1e-5, 1e-2, needs="linear"),
            Span("ridge", 1e-4, 1e-1, needs="linear"),
            Choice("robust", (None, 0.1, 0.3, 1.0)),
            Choice("windows", (240, 480)),
            Choice("hidden", (16, 32, 64), needs="network"),
            Choice("layers", (1, 2), needs="network"),
            Span("size", 0.03, 1.0, needs="network"),
        ),
        options=(
            Choice("iterations", (10, 15, 30)),
            Span("steps", GENTLE_STEPS // 2, 2 * GENTLE_STEPS, whole=True, needs="network"),
            *adam_space(facts, needs="network"),
        ),
    )


PHYSICS: tuple[Family, ...] = (
    Family(
        name="greybox",
        label="grey-box",
        use="the person's own equations, fitted in physical units",
        base=10,
        points=(("windows", -4), ("measured", -2)),
        needs=frozenset({"physics"}),
        trial=_greybox,
        full=_greybox,
        space=_greybox_space,
    ),
    Family(
        name="physics_net",
        label="physics network",
        use="equations whose states are all measured, with learned terms and a network beside them",
        base=8,
        points=(("windows", 3),),
        needs=frozenset({"physics", "measured"}),
        trial=_physics_net,
        full=_physics_net,
        space=_physics_net_space,
        methods=("feed-forward residual", "recurrent residual"),
    ),
    Family(
        name="hybrid",
        label="hybrid",
        use="the person's equations with a learned residual",
        base=3,
        points=(("windows", -2), ("measured", -2)),
        needs=frozenset({"physics"}),
        trial=_hybrid,
        full=_hybrid,
        space=_hybrid_space,
    ),
)
