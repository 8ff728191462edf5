"""An agent that doubles the length of a finite impulse response as long as that helps."""

from __future__ import annotations

from asia.agents import AgentView, Proposal
from asia.recipe import Recipe, read_recipe

_FIRST = 10


class Doubling:
    """Proposes finite impulse responses of 10, 20, 40 taps and so on, until V rises."""

    name = "doubling"

    def propose(self, view: AgentView) -> Proposal | None:
        """As `asia.agents.Agent`."""
        own = [trial for trial in view.trials if trial.family == "fir"]
        values = [trial.value for trial in own]
        if len(own) > 1 and (values[-1] is None or values[-2] is None or values[-1] > values[-2]):
            return None
        last = read_recipe(own[-1].source) if own else None
        taps = _FIRST if last is None else 2 * round(last.number("taps", _FIRST))
        recipe = Recipe(
            "fir", (("taps", taps),), "LeastSquares", (("ridge", None),), "asia_example"
        )
        title = f"finite impulse response of {taps} taps"
        return Proposal(
            source=recipe.source(title),
            family="fir",
            title=title,
            hypothesis="The response has not ended after the taps tried so far.",
            expected="Lower V on every fold.",
            parent=own[-1].number if own else None,
        )
