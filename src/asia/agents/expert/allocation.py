"""Allocation of experiments to families: the close ones take turns, and one that stalls waits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from asia.agents.library.cards.linear import BEST_LINEAR
from asia.agents.library.recipe import read_recipe
from asia.agents.library.registry import families, family
from asia.agents.view import LINEAR, AgentView, Trial

FAMILIES = 3
"""Families that are tried before any family gets a second refinement, and that are refined before
any gets a third one."""
CLOSE = 1.5
"""Ratio to the best V up to which a family competes for refinements."""
LEAD = 0.2
"""Share by which the best V of a family must be below that of every other family, so that it may
have more than half of the experiments."""
_REFINEMENTS = 2
# Refinements in a row without a gain after which a family waits.
_STALLED = 2
_GAIN = 0.01


@dataclass(frozen=True)
class Allocation:
    """Experiments and best V of each family so far."""

    tried: Counter[str]
    """Experiments with each family, the baseline included, the best linear model left out."""
    spent: Counter[str]
    """The same without the baseline."""
    best: dict[str, float]
    """The lowest V of each family that has a score. The linear reference counts as one of the
    family `linear`."""
    idle: Counter[str]
    """Experiments of each family since its V last fell by 1 %."""
    budget: int
    """Experiments of the whole search after the baseline."""
    stalled: str = ""
    """Family without given equations whose last two refinements came one after the other and gained
    nothing, while an apt family was not tried; "" for none."""

    @staticmethod
    def of(view: AgentView) -> Allocation:
        """Count the proposals so far."""
        tried, spent, best = Counter[str](), Counter[str](), dict[str, float]()
        idle, name = Counter[str](), ""
        for one in view.proposed:
            recipe = read_recipe(one.source)
            name = one.family if recipe is None else recipe.family
            # The reference told its V: it is no refinement.
            new = not one.title.endswith(BEST_LINEAR)
            tried[name] += new
            spent[name] += new and one.family != "baseline"
            value = None
            if isinstance(one, Trial) and one.variant != LINEAR:
                value = one.value
            gained = value is not None and value < (1.0 - _GAIN) * best.get(name, 1e300)
            idle[name] = 0 if gained else idle[name] + 1
            if value is not None:
                best[name] = min(value, best.get(name, value))
        if view.linear is not None:
            best["linear"] = min(view.linear, best.get("linear", view.linear))
        baselines = tried.total() - spent.total()
        row = family(name)
        last = [read_recipe(one.source) for one in view.proposed[-_STALLED:]]
        stalled = (
            all(recipe is not None and recipe.family == name for recipe in last)
            and min(idle[name], tried[name] - 1) >= _STALLED
            and row is not None
            and "physics" not in row.needs
            and any(
                row.name not in tried and row.aptness(view.facts) > 0
                for row in families(view.facts)
            )
        )
        budget = view.experiments - baselines
        return Allocation(tried, spent, best, idle, budget, name if stalled else "")

    @property
    def known(self) -> int:
        """Families of the library that were tried, the linear reference included."""
        names = {*self.tried, *self.best}
        return sum(family(name) is not None for name in names)

    def leads(self, name: str) -> bool:
        """Return whether V of the family is 20 % below that of every other one that was tried."""
        others = [value for other, value in self.best.items() if other != name]
        beaten = all(self.best.get(name, 1e300) <= (1.0 - LEAD) * value for value in others)
        return name in self.best and len(self.tried.keys() | self.best.keys()) > 1 and beaten

    @property
    def close(self) -> list[str]:
        """The best three families within 1.5 times of the best V, the best first."""
        ranked = sorted(self.best, key=lambda name: (self.best[name], name))
        return [n for n in ranked if self.best[n] <= CLOSE * self.best[ranked[0]]][:FAMILIES]

    def waits(self, name: str) -> bool:
        """Return whether other families come before one more experiment with this one: until three
        are tried, new ones before its second refinement, and before its first one if it is behind
        and has no given equations; then close ones without a refinement before its third one, close
        ones that still gain where it gained nothing twice, and new ones where it gained nothing
        twice in a row."""
        if name == self.stalled:
            return True
        refinements = self.tried[name] - 1
        if self.known < FAMILIES:
            row = family(name)
            given = row is not None and "physics" in row.needs
            behind = name in self.best and name not in self.close and not given
            return refinements >= 1 or behind
        rivals = [other for other in self.close if other != name and self.tried[other] > 0]
        if refinements >= _REFINEMENTS and any(self.tried[other] == 1 for other in rivals):
            return True
        stalled = refinements >= _STALLED and self.idle[name] >= _STALLED
        return stalled and any(self.idle[other] < _STALLED for other in rivals)

    def chance(self, name: str) -> int:
        """Place of a family in the order in which chances are given while another one waits."""
        if self.known < FAMILIES or self.stalled:
            return min(self.tried[name], 2)
        return 0 if name in self.close else 1

    def objection(self, name: str) -> str:
        """Reason why other families come before one more experiment with this one; "" for none."""
        row = family(name)
        label = name if row is None else row.label
        if self.waits(name):
            if self.known < FAMILIES:
                return (
                    f"{FAMILIES} families are tried before one is refined twice, or at all if its "
                    f"V is more than {CLOSE:g} times the best: {label} waits."
                )
            if name == self.stalled:
                return f"Two refinements gained nothing: {label} waits for a family not tried yet."
            return (
                f"{label} waits for families within {CLOSE:g} times of the best V that had fewer "
                "refinements or still gain."
            )
        if self.spent[name] >= max(1, self.budget // 2) and not self.leads(name):
            return (
                f"No family gets more than half of the {self.budget} experiments after the "
                f"baseline, unless its V is {LEAD:.0%} below all others. {label} has had "
                f"{self.spent[name]}."
            ).replace("%", " %")
        return ""
