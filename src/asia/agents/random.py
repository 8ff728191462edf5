"""Random agent, the control of a search: configurations drawn from the model library."""

import hashlib

import numpy as np

from asia.agents.library.family import Family, is_new, under_protocol
from asia.agents.library.registry import families
from asia.agents.library.space import draw
from asia.agents.view import AgentView, Facts, Proposal
from asia.recipe import Recipe

_TRIES = 50


class RandomAgent:
    """Draws a family, then its training method and settings, all with equal chance; never the same
    candidate twice."""

    proposes_ahead = True

    name = "random"

    def families(self, facts: Facts) -> tuple[Family, ...]:
        """Return the families that are drawn from."""
        return families(facts)

    def propose(self, view: AgentView) -> Proposal | None:
        """A draw fixed by the search seed and the number of proposals; None when `_TRIES` draws in
        a row were known already."""
        word = f"{self.name}:{view.seed}:{len(view.proposed)}"
        seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8], "big")
        rng = np.random.default_rng(seed)
        facts = view.facts
        rows = self.families(facts)
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
