"""Traits of a problem, by which the library's rows are chosen."""

from __future__ import annotations

import re
from typing import Literal

import numpy as np

from asia.agents.view import Facts
from asia.data.statistics import integrating, period, resonant
from asia.problem.memory import has_memory
from asia.problem.symmetry import of_signals

Trait = Literal[
    "physics", "parameters", "windows", "measured", "short", "long", "single", "several",
    "symmetric", "integrating", "resonant", "plant", "scheduling", "irregular", "feedback",
]  # fmt: skip


def traits(facts: Facts) -> frozenset[Trait]:
    """physics: equations are given; parameters: with unknown parameters in them; windows: many
    short simulations instead of whole records; measured: every state is an output or, without
    equations, the past window is one output sample; short, long: at most 2000 or at least 20 000
    samples to fit; single: one input and one output; several: more than one output; symmetric: a
    symmetry of inputs and outputs alone is declared; integrating: an output drifts with the sum of
    the inputs, and whole records are simulated; resonant: an output has a lightly damped mode, and
    whole records are simulated; plant: a simulator of the user's own is given; scheduling: an input
    is a scheduling signal; irregular: an input holds the time step; feedback: [loop] names a closed
    loop, whose noise is still in the inputs."""
    physics = facts.physics
    inputs, outputs = [s.name for s in facts.inputs], [s.name for s in facts.outputs]
    if physics is None:
        measured = (facts.n_past_u, facts.n_past_y) == (0, 1)
    else:
        seen = {physics.observation.get(name, name).strip() for name in outputs}
        measured = set(physics.states) <= seen and not has_memory(physics)
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
        "single": len(inputs) == len(outputs) == 1,
        "several": len(outputs) > 1,
        "integrating": facts.horizon is None and bool(integrating(facts.records)),
        "resonant": facts.horizon is None and resonant(facts.records),
        "symmetric": bool(of_signals(facts.symmetry, inputs, outputs)),
    }
    return frozenset(name for name, holds in found.items() if holds)


def names_places(facts: Facts) -> bool:
    """Return whether the problem says where in the equations unknown effects enter."""
    return facts.physics is not None and bool(facts.physics.corrections)


def periodic(facts: Facts) -> bool:
    """Return whether all inputs of all records have one period, and whole records are simulated."""
    return facts.horizon is None and period(facts.records) is not None


_UNSIGNED = re.compile(
    r"(?<![a-z])(magnitude|absolute (value|speed)|unsigned|rectifie[ds]|"
    r"(without|no|loses its|lost its) sign)(?![a-z])"
)


def sign_lost(facts: Facts) -> float:
    """Return how likely the outputs lack their sign: 1 where the user's words say so, 0.5 where
    every output only touches zero, 0 where one is negative."""
    y = np.concatenate([r.y for r in facts.records])
    low, high = np.quantile(y, (0.05, 0.95), axis=0)
    if (y.min(axis=0) < -0.05 * high).any() or (high <= 0).any():
        return 0.0
    names = " ".join(s.name for s in (*facts.inputs, *facts.outputs))
    text = f"{facts.description} {facts.notes} {facts.strategies} {names}".lower()
    return 1.0 if _UNSIGNED.search(text) else 0.5 * bool((low < 0.05 * high).all())
