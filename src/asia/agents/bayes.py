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

from asia.agents.library.family import Family
from asia.agents.library.protocol import is_new, under_protocol
from asia.agents.library.recipe import Recipe, Value, read_recipe
from asia.agents.library.registry import families
from asia.agents.library.space import OneOf, Parameter, Space, Span, applies
from asia.agents.view import AgentView, Facts, Proposal, Running, Trial

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution

_STARTUP = 5
_TRIES = 50
_FAMILY, _METHOD = "family", "method"
_FAILED = 2.0

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
        rows = families(view.facts)
        for attempt in range(_TRIES):
            study = _study(view, rows, attempt)
            recipe, row = _asked(study, view.facts, rows)
            if is_new(view, row, recipe):
                return Proposal(
                    source=under_protocol(recipe, row, view.facts).source(
                        f"{row.label}, chosen by a Parzen estimator."
                    ),
                    family=row.name,
                    title=f"{row.label}, estimated",
                    hypothesis="Configurations like the better ones so far, by a tree-structured "
                    f"Parzen estimator.{_record_of_others(view, rows)}",
                    expected="A lower V than the best, or information where few trials are.",
                )
        return None


def _record_of_others(view: AgentView, rows: Sequence[Family]) -> str:
    """Describe which experiments of other agents in a relay it can use."""
    others = [trial for trial in view.trials if _by_other(trial)]
    if not others:
        return ""
    read = [(trial.number, _as_asked(trial, view.facts, rows)) for trial in others]
    known = [
        f"#{number:02d} ({len(asked.params)} of {len(asked.params) + asked.lost} settings)"
        for number, asked in read
        if asked is not None
    ]
    strange = [f"#{number:02d}" for number, asked in read if asked is None]
    used = f" Of the experiments of others it uses {', '.join(known) or 'none'}"
    return used + (f"; not in its space: {', '.join(strange)}." if strange else ".")


def _by_other(trial: Trial | Running) -> bool:
    return trial.agent not in ("", BayesAgent.name)


def _study(view: AgentView, rows: Sequence[Family], attempt: int) -> Study:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    word = f"bayes:{view.seed}:{len(view.proposed)}:{attempt}"
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(n_startup_trials=_STARTUP, seed=seed)
    study = optuna.create_study(sampler=sampler)
    worst = max((t.value for t in view.trials if t.value is not None), default=1.0)
    for trial in view.proposed:
        asked = _as_asked(trial, view.facts, rows)
        if asked is not None:
            value = worst
            if isinstance(trial, Trial):
                value = trial.value if trial.value is not None else _FAILED * worst
            study.add_trial(
                optuna.trial.create_trial(
                    params=asked.params, distributions=asked.distributions, value=value
                )
            )
    return study


def _asked(study: Study, facts: Facts, rows: Sequence[Family]) -> tuple[Recipe, Family]:
    """The estimator's choice."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    trial = study.ask()

    def pick(name: str, distribution: BaseDistribution) -> Number:
        if isinstance(distribution, CategoricalDistribution):
            return int(trial.suggest_categorical(name, distribution.choices))  # type: ignore[arg-type]
        assert isinstance(distribution, FloatDistribution)
        return trial.suggest_float(name, distribution.low, distribution.high, log=distribution.log)

    row = rows[int(pick(_FAMILY, _choices(len(rows))))]
    return _built(row, facts, pick), row


@dataclass(frozen=True)
class _Asked:
    """Trial in the estimator's terms."""

    params: dict[str, Number]
    """Parameters of the trial in the estimator's terms."""
    distributions: dict[str, BaseDistribution]
    """Distributions of the parameters."""
    lost: int = 0
    """Number of settings of another agent's trial outside its search space."""


def _as_asked(trial: Trial | Running, facts: Facts, rows: Sequence[Family]) -> _Asked | None:
    """Convert an earlier trial to the estimator's terms.

    None for a source that is no recipe of the library, or lies outside the search space. Of another
    agent's trial all settings inside are used: the estimator treats each setting on its own.
    """
    recipe = read_recipe(trial.source)
    names = [row.name for row in rows]
    if recipe is None or recipe.family not in names:
        return None
    row = rows[names.index(recipe.family)]
    params: dict[str, Number] = {_FAMILY: names.index(row.name)}
    distributions: dict[str, BaseDistribution] = {_FAMILY: _choices(len(rows))}
    lost: list[str] = []
    space = row.space(facts)

    def read(name: str, distribution: BaseDistribution) -> Number:
        word = name.rpartition(".")[2]
        parameter = None if word == _METHOD else space.find(word)
        try:
            if parameter is None:
                number: Number = _method(row, facts, recipe)
            else:
                number = _number(parameter, recipe.get(word))
        except ValueError:
            if not _by_other(trial):
                raise
            lost.append(word)
            return _any_number(parameter)
        params[name], distributions[name] = number, distribution
        return number

    try:
        _built(row, facts, read)
    except ValueError:
        return None
    return _Asked(params, distributions, len(lost))


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
    for parameters, change in ((space.config, Recipe.configured), (space.options, Recipe.trained)):
        for p in parameters:
            if applies(p, recipe):
                number = pick(f"{row.name}.{p.name}", _distribution(p))
                recipe = change(recipe, **{p.name: _value(p, number)})
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


def _distribution(p: Parameter) -> BaseDistribution:
    from optuna.distributions import FloatDistribution

    return (
        FloatDistribution(p.low, p.high, log=p.log)
        if isinstance(p, Span)
        else _choices(len(p.values))
    )


def _number(p: Parameter, value: Value) -> Number:
    """Convert a value to the estimator's number.

    Raises:
        ValueError: for a value outside the space
    """
    if isinstance(p, OneOf):
        return p.values.index(value)
    if not isinstance(value, int | float) or not p.low <= value <= p.high:
        raise ValueError(p.name)
    return float(value)


def _any_number(p: Parameter | None) -> Number:
    """Return a placeholder for a value outside the space."""
    return p.low if isinstance(p, Span) else 0


def _value(p: Parameter, number: Number) -> Value:
    return p.values[int(number)] if isinstance(p, OneOf) else p.tidy(float(number))
