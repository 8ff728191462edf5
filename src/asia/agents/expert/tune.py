"""Tuning the numbers of the leading recipe by a tree-structured Parzen estimator.

Source: Bergstra, Bardenet, Bengio and Kegl, NeurIPS 2011; Optuna's implementation. The study lives
in memory and is rebuilt from the ledger's trials at each proposal, so that a proposal is a function
of the view.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from asia.agents.library.family import is_new
from asia.agents.library.move import plain_title
from asia.agents.library.recipe import Recipe, read_recipe
from asia.agents.library.space import Span

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

    from asia.agents.library.move import Situation
    from asia.agents.view import Trial

TUNED = "numbers tuned"

# The length of a fit determines its cost: moves change it, tuning does not.
_EFFORT = frozenset({"steps", "iterations", "starts", "members", "truncation"})


def may_tune(at: Situation) -> bool:
    """Return whether the leading recipe has numbers to tune and the tuned experiments, at most a
    fifth of the budget, are not used up."""
    used = sum(plain_title(trial.title).endswith(f": {TUNED}") for trial in at.view.proposed)
    return used < 0.2 * at.view.experiments and bool(_spans(at))


def tuned(at: Situation) -> Recipe:
    """The recipe with numbers near the best ones, where the trials so far promise most; the
    recipe itself when nothing new was found."""
    import optuna
    from optuna.distributions import FloatDistribution

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    word = f"tune:{at.view.seed}:{len(at.view.proposed)}"
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(n_startup_trials=4, multivariate=True, seed=seed)
    study = optuna.create_study(sampler=sampler)
    spans = _spans(at)
    ranges: dict[str, BaseDistribution] = {
        span.name: FloatDistribution(*_range(at, span), log=True) for span in spans
    }
    for trial in at.view.trials:
        params = _parameters(at, trial, spans)
        if params is not None and trial.value is not None:
            study.add_trial(
                optuna.trial.create_trial(params=params, distributions=ranges, value=trial.value)
            )
    for _ in range(8):
        asked = study.ask(ranges).params
        recipe = at.recipe.changed(**{s.name: s.tidy(asked[s.name]) for s in spans})
        if is_new(at.view, at.row, recipe):
            return recipe
    return at.recipe


def _spans(at: Situation) -> tuple[Span, ...]:
    spans = at.row.space(at.facts).spans(at.recipe)
    return tuple(span for span in spans if span.name not in _EFFORT)


def _parameters(at: Situation, trial: Trial, spans: tuple[Span, ...]) -> dict[str, float] | None:
    """A trial's numbers; None when it differs from the leading one in more, or lies too far."""
    recipe = read_recipe(trial.source)
    if recipe is None or not all(recipe.has(span.name) for span in spans):
        return None
    if recipe.changed(**{s.name: at.recipe.get(s.name) for s in spans}).key != at.recipe.key:
        return None
    numbers = {span.name: recipe.number(span.name, 0.0) for span in spans}
    for span in spans:
        low, high = _range(at, span)
        if not low <= numbers[span.name] <= high:
            return None
    return numbers


def _range(at: Situation, span: Span) -> tuple[float, float]:
    """Return a range of a factor of three to each side of the leading recipe's number, limited to
    the library's range extended to that number."""
    centre = at.recipe.number(span.name, span.low)
    low, high = max(span.low, centre / 3.0), min(span.high, centre * 3.0)
    return min(low, centre), max(high, centre)
