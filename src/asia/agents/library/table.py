"""The model library as the built-in agents know it: one row a family. `expert` and `random` search
the same rows.

A new family is a row in one of the tables here; everything else follows from it.
"""

from __future__ import annotations

from asia.agents._view import Facts
from asia.agents.library.cards.rows_classical import CLASSICAL
from asia.agents.library.cards.rows_networks import NETWORKS
from asia.agents.library.cards.rows_physics import PHYSICS
from asia.agents.library.family import Family

FAMILIES: tuple[Family, ...] = (*PHYSICS, *CLASSICAL, *NETWORKS)


def families(facts: Facts) -> tuple[Family, ...]:
    """The rows that suit a problem, the most apt first; the table's order where that is equal."""
    rows = [row for row in FAMILIES if row.suits(facts)]
    return tuple(sorted(rows, key=lambda row: -row.aptness(facts)))


def family(name: str) -> Family | None:
    """A row by name."""
    return next((row for row in FAMILIES if row.name == name), None)
