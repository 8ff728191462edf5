"""Stop criterion: the noise floor is reached."""

from __future__ import annotations

from statistics import NormalDist

from asia.agents._view import AgentView, Trial
from asia.agents.library.evidence import overfit, worst
from asia.agents.library.records.levels import noise_of_periods

# Further tries that all must fail, and the share of V by which one of them counts as a gain.
_TRIES, _GAIN = 3, 0.01
# V over the training error up to which nothing is left.
_AT_TRAINING = 1.03
# V over the noise that repeated periods show, likewise.
_AT_FLOOR = 1.03
_LAGS = 20
_LEVEL = 0.01


def reason_to_end(view: AgentView) -> str | None:
    """Return the reason to end the search now, in a sentence; None to continue."""
    best = view.best
    if best is None or _tries_since_gain(view) < _TRIES:
        return None
    floor = noise_of_periods(view.facts) if view.facts.metric == "rmse" else None
    if floor is not None and best.value is not None and best.value <= _AT_FLOOR * floor:
        return (
            f"V of #{best.number:02d} is {best.value:.3g}, the variation between the periods of "
            f"the "
            f"records is {floor:.3g} of the output, and {_TRIES} further experiments gained less "
            "than 1 %: the noise floor is reached"
        )
    if not nothing_left(view, best):
        return None
    return (
        f"the residuals of #{best.number:02d} are white and independent of the inputs within 99 % "
        "bands, its V equals its training error, and "
        f"{_TRIES} further experiments gained less than 1 %: the noise floor is reached"
    )


def nothing_left(view: AgentView, trial: Trial) -> bool:
    """Return whether residuals of the training side look like noise alone, and V agrees with them.

    Bands hold for all lags, signals and folds together. Windows overlap, so that residuals in them
    tell no bands.
    """
    facts = view.facts
    train = trial.train_error
    if facts.horizon is not None or trial.value is None or not train:
        return False
    if not 1 / _AT_TRAINING**2 < overfit(trial) <= _AT_TRAINING:
        return False
    outputs, inputs = len(facts.outputs), len(facts.inputs)
    band = _band(facts.fit_samples, _LAGS * outputs * (1 + inputs) * max(1, len(trial.folds)))
    return (
        worst(trial, lambda d: d.whiteness) < band
        and worst(trial, lambda d: d.input_correlation) < band
        and worst(trial, lambda d: d.curvature) < band
    )


def _band(samples: int, tests: int) -> float:
    """Return the 99 % quantile of the largest of `tests` correlations of white noise."""
    return NormalDist().inv_cdf(1.0 - _LEVEL / (2 * tests)) / max(samples, 1) ** 0.5


def _tries_since_gain(view: AgentView) -> int:
    """Trials since the last one that was better than all before it by more than the least gain."""
    best, last = float("inf"), 0
    for place, trial in enumerate(view.trials, 1):
        if trial.value is not None and trial.value < (1.0 - _GAIN) * best:
            best, last = trial.value, place
    return len(view.trials) - last
