"""Plants of the catalogue that a problem looks like, and what they usually have."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from asia.agents.library.traits import sign_lost
from asia.agents.view import Facts
from asia.data.process import SameRecords
from asia.data.trajectory import Signal
from asia.errors import UserError
from asia.plants.recognition import MOST_LIKELY, Likeness, likely, recognise
from asia.problem.physics_text import written_physics


def likely_plants(facts: Facts) -> tuple[Likeness, ...]:
    """At most two plants that the problem looks like, the likelier first; () is "unknown"."""
    return likely(_ranked_of(facts))


def _ranked_of(facts: Facts) -> tuple[Likeness, ...]:
    words = f"{facts.description} {facts.notes} {facts.strategies}"
    return _ranked(words, facts.inputs, facts.outputs, SameRecords(facts.records))


@lru_cache(maxsize=8)
def _ranked(
    words: str, inputs: tuple[Signal, ...], outputs: tuple[Signal, ...], records: SameRecords
) -> tuple[Likeness, ...]:
    return recognise(words, inputs, outputs, records.records)


def usual_effects(facts: Facts) -> frozenset[str]:
    """Settings of the grey-box for effects that such plants usually have: the two nearest, unless
    the words speak against them."""
    near = (one for one in _ranked_of(facts)[:MOST_LIKELY] if one.score > 0)
    return frozenset(effect for one in near for effect in one.plant.entry.effects)


def equations_of(facts: Facts, one: Likeness) -> tuple[str, ...]:
    """Equations of a plant in the names of the problem, one text for each assignment of signals to
    roles, with and without a sensor without sign where the sign may be lost; () where a name cannot
    be written in them."""
    try:
        signed = [
            one.plant.physics(m, facts.inputs, facts.outputs, facts.records) for m in one.mappings
        ]
    except UserError:
        return ()
    lost, names = sign_lost(facts), [s.name for s in facts.outputs]
    unsigned = [
        replace(p, observation={n: f"abs({p.observation.get(n, n)})" for n in names})
        for p in signed
    ]
    return tuple(map(written_physics, (*signed * (lost < 1.0), *unsigned * (lost > 0.0))))
