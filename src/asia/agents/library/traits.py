"""Traits of a problem, by which the library's rows are chosen."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

import numpy as np

from asia.agents.view import Facts
from asia.data.statistics import integrating, period, resonant
from asia.data.trajectory import Array
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


# Change of the slope at the turns of an output at zero over the largest slope near them: about 1
# for a magnitude, and the less for a smooth output, the more samples a turn has.
_SHARP = 0.3


def sign_lost(facts: Facts) -> float:
    """Return how likely the outputs lack their sign: 1 where the user's words say so, 0.5 where
    every output bounces off zero, 0 where one is negative."""
    y = np.concatenate([r.y for r in facts.records])
    high = np.quantile(y, 0.95, axis=0)
    if (y.min(axis=0) < -0.05 * high).any() or (high <= 0).any():
        return 0.0
    names = " ".join(s.name for s in (*facts.inputs, *facts.outputs))
    text = f"{facts.description} {facts.notes} {facts.strategies} {names}".lower()
    if _UNSIGNED.search(text):
        return 1.0
    return 0.5 * all(_bounces([r.y[:, k] for r in facts.records], h) for k, h in enumerate(high))


def _bounces(outputs: Sequence[Array], high: float) -> bool:
    """Return whether an output turns at zero within a sample or two, as a magnitude does: the
    motion of a signed output that turns there slows down first.

    Args:
        outputs: of each record (T,)
        high: a large value of the output
    """
    turns = list[float]()
    for y in outputs:
        near = np.concatenate([[0], y < 0.05 * high, [0]])
        visits = zip(
            np.flatnonzero(np.diff(near) > 0), np.flatnonzero(np.diff(near) < 0), strict=True
        )
        for first, last in ((a, b) for a, b in visits if a > 0 and b < len(y)):
            k = first + int(np.argmin(y[first:last]))
            fastest = np.abs(np.diff(y[first - 1 : last + 1])).max()
            turns.append(float(y[k - 1] - 2.0 * y[k] + y[k + 1]) / fastest)
    return bool(turns) and float(np.median(turns)) > _SHARP
