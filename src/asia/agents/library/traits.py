"""Traits of a problem, by which the library's rows are chosen."""

from __future__ import annotations

from typing import Literal

from asia.agents.library.record_facts import integrating, resonant
from asia.agents.view import Facts
from asia.problem.symmetry import of_signals

Trait = Literal[
    "physics", "parameters", "windows", "measured", "short", "long", "several", "symmetric",
    "integrating", "resonant", "plant", "scheduling", "irregular", "feedback",
]  # fmt: skip


def traits(facts: Facts) -> frozenset[Trait]:
    """physics: equations are given; parameters: with unknown parameters in them; windows: many
    short simulations instead of whole records; measured: every state is an output or, without
    equations, the past window is one output sample; short, long: at most 2000 or at least 20 000
    samples to fit; several: more than one output; symmetric: a symmetry of inputs and outputs alone
    is declared; integrating: an output drifts with the sum of the inputs, and whole records are
    simulated; resonant: an output has a lightly damped mode, and whole records are simulated;
    plant: a simulator of the user's own is given; scheduling: an input is a scheduling signal;
    irregular: an input holds the time step; feedback: [loop] names a closed loop, whose noise is
    still in the inputs."""
    physics = facts.physics
    inputs, outputs = [s.name for s in facts.inputs], [s.name for s in facts.outputs]
    if physics is None:
        measured = (facts.past_inputs, facts.past_outputs) == (0, 1)
    else:
        seen = {physics.observation.get(name, name).strip() for name in outputs}
        measured = set(physics.states) <= seen
    found: dict[Trait, bool] = {
        "physics": physics is not None,
        "parameters": physics is not None and bool(physics.parameters),
        "plant": facts.plant is not None,
        "scheduling": any(s.role == "scheduling" for s in facts.inputs),
        "irregular": any(s.role == "time_step" for s in facts.inputs),
        "feedback": facts.loop is not None and bool(facts.loop.methods),
        "windows": facts.horizon is not None,
        "measured": measured,
        "short": facts.fit_samples <= 2_000,
        "long": facts.fit_samples >= 20_000,
        "several": len(outputs) > 1,
        "integrating": facts.horizon is None and bool(integrating(facts)),
        "resonant": facts.horizon is None and resonant(facts),
        "symmetric": bool(of_signals(facts.symmetry, inputs, outputs)),
    }
    return frozenset(name for name, holds in found.items() if holds)


def names_places(facts: Facts) -> bool:
    """Return whether the problem says where in the equations unknown effects enter."""
    return facts.physics is not None and bool(facts.physics.corrections)
