"""Tuning the numbers of the leading recipe by a tree-structured Parzen estimator.

Source: Bergstra, Bardenet, Bengio and Kegl, NeurIPS 2011; Optuna's implementation. The study lives
in memory and is rebuilt from the ledger's trials at each proposal, so that a proposal is a function
of the view.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from asia.agents.expert.titles import plain_title
from asia.agents.library.protocol import is_new
from asia.agents.library.recipe import Recipe, read_recipe
from asia.agents.library.space import Span

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution

    from asia.agents.library.move import Situation
    from asia.agents.view import Trial

TUNED = "numbers tuned"

_SHARE = 0.2
_REACH = 3.0
_ASKS = 8
_STARTUP = 4
# The length of a fit determines its cost: moves change it, tuning does not.
_EFFORT = frozenset({"steps", "iterations", "starts", "members", "truncation"})


def may_tune(at: Situation) -> bool:
    """Return whether the leading recipe has numbers to tune and the tuned experiments, at most a
    fifth of the budget, are not used up."""
    used = sum(plain_title(trial.title).endswith(f": {TUNED}") for trial in at.view.proposed)
    return used < _SHARE * at.view.experiments and bool(_spans(at))


def tuned(at: Situation) -> Recipe:
    """The recipe with numbers near the best ones, where the trials so far promise most; the
    recipe itself when nothing new was found."""
    spans = _spans(at)
    study = _study(at, spans)
    for _ in range(_ASKS):
        asked = study.ask(_distributions(at, spans)).params
        recipe = at.recipe.changed(**{s.name: s.tidy(asked[s.name]) for s in spans})
        if is_new(at.view, at.row, recipe):
            return recipe
    return at.recipe


def _spans(at: Situation) -> tuple[Span, ...]:
    spans = at.row.space(at.facts).spans(at.recipe)
    return tuple(span for span in spans if span.name not in _EFFORT)


def _study(at: Situation, spans: tuple[Span, ...]) -> Study:
    """The trials that differ from the leading one in these numbers alone, as Optuna sees them."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(
        n_startup_trials=_STARTUP, multivariate=True, seed=_seed(at)
    )
    study = optuna.create_study(sampler=sampler)
    distributions = _distributions(at, spans)
    for trial in at.view.trials:
        params = _parameters(at, trial, spans)
        if params is not None and trial.value is not None:
            past = optuna.trial.create_trial(
                params=params, distributions=distributions, value=trial.value
            )
            study.add_trial(past)
    return study


def _parameters(at: Situation, trial: Trial, spans: tuple[Span, ...]) -> dict[str, float] | None:
    """A trial's numbers; None when it differs from the leading one in more, or lies too far."""
    recipe = read_recipe(trial.source)
    if recipe is None or not all(recipe.has(span.name) for span in spans):
        return None
    numbers = {span.name: recipe.number(span.name, 0.0) for span in spans}
    if recipe.changed(**{s.name: at.recipe.get(s.name) for s in spans}).key != at.recipe.key:
        return None
    ranges = [(numbers[span.name], *_range(at, span)) for span in spans]
    return numbers if all(low <= number <= high for number, low, high in ranges) else None


def _distributions(at: Situation, spans: tuple[Span, ...]) -> dict[str, BaseDistribution]:
    from optuna.distributions import FloatDistribution

    return {span.name: FloatDistribution(*_range(at, span), log=True) for span in spans}


def _range(at: Situation, span: Span) -> tuple[float, float]:
    """Return a range of a factor of three to each side of the leading recipe's number, limited to
    the library's range extended to that number."""
    centre = at.recipe.number(span.name, span.low)
    low, high = max(span.low, centre / _REACH), min(span.high, centre * _REACH)
    return min(low, centre), max(high, centre)


def _seed(at: Situation) -> int:
    word = f"tune:{at.view.seed}:{len(at.view.proposed)}"
    return int.from_bytes(hashlib.sha256(word.encode()).digest()[:4], "big")
