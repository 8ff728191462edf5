"""Tree-structured Parzen estimator over everything in the library: a control that learns from
outcomes alone.

Source: Bergstra, Bardenet, Bengio and Kegl, NeurIPS 2011; Optuna's implementation. Family, training
method and settings are one conditional space. The study lives in memory and is rebuilt from the
ledger's trials at each proposal, so that a proposal is a function of the view.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from asia.agents.library.family import Family, is_new, under_protocol
from asia.agents.library.registry import families
from asia.agents.library.space import OneOf, Space, applies
from asia.agents.view import AgentView, Facts, Proposal, Running, Trial
from asia.recipe import Recipe, read_recipe

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution

_TRIES = 50
_FAMILY, _METHOD = "family", "method"

Number: TypeAlias = int | float
Pick: TypeAlias = "Callable[[str, BaseDistribution], Number]"


class BayesAgent:
    """Agent that proposes the candidate with the largest expected improvement.

    Running experiments count as trials as bad as the worst so far, which keeps the estimator away
    from them: the constant liar of Ginsbourger, Le Riche and Carraro (Computational Intelligence in
    Expensive Optimization Problems, 2010).
    """

    name = "bayes"
    proposes_ahead = True

    def propose(self, view: AgentView) -> Proposal | None:
        """The estimator's choice; None when `_TRIES` of them in a row were known already."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution

        rows = families(view.facts)
        for attempt in range(_TRIES):
            trial = _study(view, rows, attempt).ask()

            def pick(
                name: str, distribution: BaseDistribution, trial: optuna.Trial = trial
            ) -> Number:
                if isinstance(distribution, CategoricalDistribution):
                    return int(trial.suggest_categorical(name, distribution.choices))  # type: ignore[arg-type]
                assert isinstance(distribution, FloatDistribution)
                low, high = distribution.low, distribution.high
                return trial.suggest_float(name, low, high, log=distribution.log)

            row = rows[int(pick(_FAMILY, _choices(len(rows))))]
            recipe = _built(row, view.facts, pick)
            if is_new(view, row, recipe):
                return Proposal(
                    source=under_protocol(recipe, row, view.facts).source(
                        f"{row.label}, chosen by a Parzen estimator."
                    ),
                    family=row.name,
                    title=f"{row.label}, estimated",
                    hypothesis="Configurations like the better ones so far, by a tree-structured "
                    "Parzen estimator.",
                    expected="A lower V than the best, or information where few trials are.",
                )
        return None


def _study(view: AgentView, rows: Sequence[Family], attempt: int) -> optuna.Study:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    word = f"bayes:{view.seed}:{len(view.proposed)}:{attempt}"
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(n_startup_trials=5, seed=seed)
    study = optuna.create_study(sampler=sampler)
    worst = max((t.value for t in view.trials if t.value is not None), default=1.0)
    for trial in view.proposed:
        encoded = _encode_trial(trial, view.facts, rows)
        if encoded is not None:
            value = worst
            if isinstance(trial, Trial):
                value = trial.value if trial.value is not None else 2.0 * worst
            study.add_trial(
                optuna.trial.create_trial(
                    params=encoded.params, distributions=encoded.distributions, value=value
                )
            )
    return study


@dataclass(frozen=True)
class _EncodedTrial:
    """Trial in the estimator's terms."""

    params: dict[str, Number]
    distributions: dict[str, BaseDistribution]
    """Distributions of the parameters."""


def _encode_trial(
    trial: Trial | Running, facts: Facts, rows: Sequence[Family]
) -> _EncodedTrial | None:
    """Convert an earlier trial to the estimator's terms.

    None for a source that is no recipe of the library, or lies outside the search space.
    """
    recipe = read_recipe(trial.source)
    names = [row.name for row in rows]
    if recipe is None or recipe.family not in names:
        return None
    row = rows[names.index(recipe.family)]
    params: dict[str, Number] = {_FAMILY: names.index(row.name)}
    distributions: dict[str, BaseDistribution] = {_FAMILY: _choices(len(rows))}
    space = row.space(facts)

    def read(name: str, distribution: BaseDistribution) -> Number:
        word = name.rpartition(".")[2]
        parameter = None if word == _METHOD else space.find(word)
        value = recipe.get(word)
        if parameter is None:
            number: Number = _method(row, facts, recipe)
        elif isinstance(parameter, OneOf):
            number = parameter.values.index(value)
        elif isinstance(value, int | float) and parameter.low <= value <= parameter.high:
            number = float(value)
        else:
            raise ValueError(word)
        params[name], distributions[name] = number, distribution
        return number

    try:
        _built(row, facts, read)
    except ValueError:
        return None
    return _EncodedTrial(params, distributions)


def _built(row: Family, facts: Facts, pick: Pick) -> Recipe:
    """The recipe of a family, every parameter that has a meaning in it picked."""
    space = row.space(facts)
    recipe = _picked(row, row.trial(facts), space, pick)
    if row.methods:
        method = int(pick(f"{row.name}.{_METHOD}", _choices(1 + len(row.methods))))
        if method > 0:
            changed = row.methods[method - 1](facts, recipe)
            recipe = _picked(row, changed, space.opened(recipe, changed), pick)
    return recipe if row.settle is None else row.settle(facts, recipe)


def _picked(row: Family, recipe: Recipe, space: Space, pick: Pick) -> Recipe:
    from optuna.distributions import FloatDistribution

    for parameters, change in ((space.config, Recipe.configured), (space.options, Recipe.trained)):
        for p in parameters:
            if not applies(p, recipe):
                continue
            name = f"{row.name}.{p.name}"
            if isinstance(p, OneOf):
                value = p.values[int(pick(name, _choices(len(p.values))))]
            else:
                value = p.tidy(float(pick(name, FloatDistribution(p.low, p.high, log=p.log))))
            recipe = change(recipe, **{p.name: value})
    return recipe


def _method(row: Family, facts: Facts, recipe: Recipe) -> int:
    """0 for the trial's own method, else the place of the other in `row.methods`, plus one."""
    own = row.trial(facts)
    if recipe.method == own.method and not recipe.get("network"):
        return 0
    for i, change in enumerate(row.methods):
        made = change(facts, own)
        if (made.method, made.get("network")) == (recipe.method, recipe.get("network")):
            return i + 1
    raise ValueError(recipe.method)


def _choices(count: int) -> BaseDistribution:
    from optuna.distributions import CategoricalDistribution

    return CategoricalDistribution(tuple(range(count)))
