"""The control: configurations drawn at random from the library the expert uses."""

from __future__ import annotations

import hashlib

import numpy as np

from asia.agents._library import Choices, Family, families
from asia.agents._recipe import Recipe, Settings
from asia.agents._view import AgentView, Facts, Proposal

_TRIES = 50


class RandomAgent:
    """Draws a family, then its settings, all with equal chance; never the same candidate twice."""

    @property
    def name(self) -> str:
        """`random`."""
        return "random"

    def propose(self, view: AgentView) -> Proposal | None:
        """A draw fixed by the search seed and the number of trials; None when `_TRIES` draws in
        a row were known already."""
        word = f"random:{view.seed}:{len(view.trials)}"
        seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8], "big")
        rng = np.random.default_rng(seed)
        rows = families(view.facts)
        for _ in range(_TRIES):
            row = rows[int(rng.integers(len(rows)))]
            recipe = _draw(rng, row, view.facts)
            source = recipe.source(f"{row.label}, drawn at random.")
            if not view.is_known(source):
                return Proposal(
                    source=source,
                    family=row.name,
                    title=f"{row.label}, drawn",
                    hypothesis="None: a random draw from the library is the control.",
                    expected="Nothing in particular.",
                )
        return None


def _draw(rng: np.random.Generator, row: Family, facts: Facts) -> Recipe:
    start = row.start(facts)
    recipe = Recipe(row.name, _pick(rng, row.config(facts)), start.method, ())
    recipe = recipe.trained(**dict(_pick(rng, row.options)))
    if recipe.get("spill") and not recipe.get("saturation"):
        recipe = recipe.configured(spill=False)
    return recipe


def _pick(rng: np.random.Generator, choices: Choices) -> Settings:
    return tuple((name, values[int(rng.integers(len(values)))]) for name, values in choices)
