"""Anonymous view of a search, to measure the value of knowing the system."""

from __future__ import annotations

import re
from dataclasses import replace

from asia.agents._view import AgentView, Facts
from asia.data import Signal


def anonymous(view: AgentView) -> AgentView:
    """Remove the identity of the system from a view.

    Signals become u1.. and y1.. without units, records r1..; description, equations, notes from the
    literature and strategies are removed. Names are replaced in the messages of failed candidates,
    too. Array columns keep their order, so that candidates need no names.
    """
    facts = view.facts
    names = _names(facts)
    words = re.compile("|".join(rf"(?<!\w){re.escape(n)}(?!\w)" for n in names)) if names else None

    def renamed(text: str) -> str:
        return text if words is None else words.sub(lambda found: names[found.group()], text)

    return replace(
        view,
        facts=_facts(facts),
        trials=tuple(
            replace(t, error=renamed(t.error), evidence=tuple(map(renamed, t.evidence)))
            for t in view.trials
        ),
    )


def _facts(facts: Facts) -> Facts:
    records = {r.name: f"r{i}" for i, r in enumerate(facts.records, 1)}
    return replace(
        facts,
        description="",
        notes="",
        strategies="",
        physics=None,
        symmetry={},
        inputs=tuple(Signal(f"u{i}") for i in range(1, len(facts.inputs) + 1)),
        outputs=tuple(Signal(f"y{i}") for i in range(1, len(facts.outputs) + 1)),
        records=tuple(replace(record, name=f"r{i}") for i, record in enumerate(facts.records, 1)),
        groups=tuple(tuple(records.get(n, n) for n in group) for group in facts.groups),
    )


def _names(facts: Facts) -> dict[str, str]:
    """Real name to alias, the longest first, so that none is replaced inside another."""
    names = {r.name: f"r{i}" for i, r in enumerate(facts.records, 1)}
    states = facts.physics.states if facts.physics else ()
    for letter, given in (
        ("x", states),
        ("y", [s.name for s in facts.outputs]),
        ("u", [s.name for s in facts.inputs]),
    ):
        names |= {name: f"{letter}{i}" for i, name in enumerate(given, 1)}
    units = {s.unit for s in (*facts.inputs, *facts.outputs) if s.unit}
    names = {**dict.fromkeys(units, "unit"), **names}
    return {n: names[n] for n in sorted(names, key=lambda n: (-len(n), n)) if n}
