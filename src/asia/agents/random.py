"""Random agents: draws from the library, or from the search space of the paper."""

import hashlib
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from asia.agents.library.family import FEWEST_STEPS, Family, is_new, under_protocol
from asia.agents.library.methods import adam
from asia.agents.library.registry import families, family
from asia.agents.library.space import OneOf, Space, Span, draw
from asia.agents.view import AgentView, Facts, Proposal
from asia.recipe import Recipe

# The random control of Piga and Forgione: an LSTM that runs freely on its own output, alone or as
# the residual of the equations, with width, depth, learning rate, dropout and weight decay drawn.


def paper_families(facts: Facts) -> tuple[Family, ...]:
    """The paper's two model classes, the second where the problem has equations for it; fits are
    long ones, by Adam alone."""
    space = Space(
        config=(Span("hidden", 16, 128, whole=True), OneOf("layers", (1, 2, 3))),
        options=(
            Span("learning_rate", 1e-4, 1e-2),
            Span("dropout", 0.0, 0.3, log=False),
            Span("weight_decay", 1e-6, 1e-2),
        ),
    )

    def start(row: Family, facts: Facts) -> Recipe:
        if row.name == "physics_net":
            config = (("network", "lstm"), ("hidden", 32), ("layers", 1))
            return Recipe("physics_net", config, "Adam", adam(facts, "heavy", "full", 1e-3))
        return row.full(facts).configured(cell="lstm")

    def settle(_: Facts, recipe: Recipe) -> Recipe:
        """Fewer steps for networks larger than the one that the number was reckoned for: an update
        costs about the square of the width, times the layers."""
        larger = recipe.number("layers", 1) * (recipe.number("hidden", 32) / 32) ** 2
        steps = recipe.number("steps", FEWEST_STEPS) / max(1.0, larger)
        return recipe.trained(steps=max(FEWEST_STEPS, round(steps)))

    rows = (family(name) for name in ("autoregressive", "physics_net"))
    return tuple(
        replace(row, start=partial(start, row), space=lambda _: space, methods=(), settle=settle)
        for row in rows
        if row is not None and row.suits(facts)
    )


# The controls: configurations drawn at random, from the library the expert uses or from the
# paper's space.


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
