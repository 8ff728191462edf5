"""The controls: configurations drawn at random, from the library the expert uses or from the
paper's space."""

from __future__ import annotations

import hashlib
from typing import Literal, get_args

import numpy as np

from asia.agents._view import AgentView, Facts, Proposal
from asia.agents.controls.paper import paper_families
from asia.agents.library.family import Family
from asia.agents.library.protocol import is_new, under_protocol
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import draw
from asia.agents.library.table import families

SpaceName = Literal["library", "paper"]
SPACES: tuple[SpaceName, ...] = get_args(SpaceName)

_TRIES = 50


class RandomAgent:
    """Draws a family, then its training method and settings, all with equal chance; never the same
    candidate twice."""

    proposes_ahead = True

    def __init__(self, space: SpaceName = "library") -> None:
        self._space: SpaceName = space

    @property
    def name(self) -> str:
        """`random`, or `random-paper` for the paper's space."""
        return "random" if self._space == "library" else f"random-{self._space}"

    def propose(self, view: AgentView) -> Proposal | None:
        """A draw fixed by the search seed and the number of proposals; None when `_TRIES` draws in
        a row were known already."""
        word = f"{self.name}:{view.seed}:{len(view.proposed)}"
        seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8], "big")
        rng = np.random.default_rng(seed)
        facts = view.facts
        rows = families(facts) if self._space == "library" else paper_families(facts)
        for _ in range(_TRIES):
            row = rows[int(rng.integers(len(rows)))]
            recipe = _drawn(rng, row, facts)
            if is_new(view, row, recipe):
                return Proposal(
                    source=under_protocol(recipe, row, facts).source(
                        f"{row.label}, drawn at random."
                    ),
                    family=row.name,
                    title=f"{row.label}, drawn",
                    hypothesis="None: a random draw is the control.",
                    expected="Nothing in particular.",
                )
        return None


def _drawn(rng: np.random.Generator, row: Family, facts: Facts) -> Recipe:
    space = row.space(facts)
    recipe = draw(rng, row.trial(facts), space)
    other = int(rng.integers(1 + len(row.methods)))
    if other > 0:
        changed = row.methods[other - 1](facts, recipe)
        recipe = draw(rng, changed, space.opened(recipe, changed))
    return recipe if row.settle is None else row.settle(facts, recipe)
