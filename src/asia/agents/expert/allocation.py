"""Allocation of experiments to families: none takes the budget before others had their chance."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from asia.agents.library.recipe import read_recipe
from asia.agents.library.registry import family
from asia.agents.view import AgentView, Trial

FAMILIES = 3
"""Families that get a trial and a refinement before any family gets more."""
LEAD = 0.2
"""Share by which the best V of a family must be below that of every other family, so that it may
have more than half of the experiments."""
_BOTH = 2


@dataclass(frozen=True)
class Allocation:
    """Experiments and best V of each family so far."""

    tried: Counter[str]
    """Experiments with each family, the baseline included."""
    spent: Counter[str]
    """The same without the baseline."""
    best: dict[str, float]
    """The lowest V of each family that has a score. The linear reference counts as one of the
    family `linear`."""
    budget: int
    """Experiments of the whole search after the baseline."""

    @staticmethod
    def of(view: AgentView) -> Allocation:
        """Count the proposals so far."""
        tried, spent, best = Counter[str](), Counter[str](), dict[str, float]()
        for one in view.proposed:
            recipe = read_recipe(one.source)
            name = one.family if recipe is None else recipe.family
            tried[name] += 1
            spent[name] += one.family != "baseline"
            if isinstance(one, Trial) and one.value is not None:
                best[name] = min(one.value, best.get(name, one.value))
        if view.linear is not None:
            best["linear"] = min(view.linear, best.get("linear", view.linear))
        baselines = tried.total() - spent.total()
        return Allocation(tried, spent, best, view.experiments - baselines)

    @property
    def known(self) -> int:
        """Families of the library that were tried."""
        return sum(family(name) is not None for name in self.tried)

    def leads(self, name: str) -> bool:
        """Return whether V of the family is 20 % below that of every other one that was tried."""
        others = [value for other, value in self.best.items() if other != name]
        beaten = all(self.best.get(name, 1e300) <= (1.0 - LEAD) * value for value in others)
        return name in self.best and len(self.tried.keys() | self.best.keys()) > 1 and beaten

    def chances_are_due(self, name: str) -> bool:
        """Return whether other families come before a third experiment with this one. A family with
        equations continues while it leads at least two others."""
        served = sum(count >= _BOTH for count in self.tried.values())
        if self.tried[name] < _BOTH or served >= FAMILIES:
            return False
        row = family(name)
        equations = row is not None and row.kind == "equations"
        reference = "linear" in self.best and not self.tried["linear"]
        return not (equations and self.known + reference >= FAMILIES and self.leads(name))

    def chance(self, name: str) -> int:
        """Place of a family in the order in which chances are given: new families until three are
        tried, then those that wait for their refinement."""
        wanted = 0 if self.known < FAMILIES else 1
        return abs(min(self.tried[name], _BOTH) - wanted)

    def objection(self, name: str) -> str:
        """Reason why other families come before one more experiment with this one; "" for none."""
        row = family(name)
        label = name if row is None else row.label
        if self.chances_are_due(name):
            return (
                f"{FAMILIES} families get a trial and one refinement each before any family gets a "
                f"third experiment: {label} waits."
            )
        if self.spent[name] >= max(1, self.budget // 2) and not self.leads(name):
            return (
                f"No family gets more than half of the {self.budget} experiments after the "
                f"baseline, unless its V is {LEAD:.0%} below all others. {label} has had "
                f"{self.spent[name]}."
            ).replace("%", " %")
        return ""
