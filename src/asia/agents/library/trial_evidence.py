"""Evidence from training residuals and errors for the choice of the next move."""

from collections.abc import Callable

from asia.agents.view import Trial
from asia.judge.scoring.residuals import Diagnostics


def worst(trial: Trial, read: Callable[[Diagnostics], float]) -> float:
    """The largest value of a diagnostic over the folds; 0 without evidence."""
    return max((read(d) for d in trial.diagnostics), default=0.0)


def overfit(trial: Trial) -> float:
    """V over the training error: far above 1 the model has learned its own fold."""
    train = trial.train_error
    if trial.value is None or not train:
        return 1.0
    return trial.value / train


def coloured(trial: Trial) -> bool:
    """The residual is far from white: dynamics are missing."""
    return worst(trial, lambda d: d.whiteness) > 0.5


def biased(trial: Trial) -> bool:
    """The mean residual is not small."""
    return worst(trial, lambda d: d.bias) > 0.03


def fails_on_top(trial: Trial) -> bool:
    """Errors gather where the output is highest."""
    return worst(trial, lambda d: d.top_error) > 1.3


def input_left(trial: Trial) -> bool:
    """The input still explains part of the residual."""
    return worst(trial, lambda d: d.input_correlation) > 0.25


def curved(trial: Trial) -> bool:
    """The residual goes with the square of the output: a static nonlinearity is missing."""
    return worst(trial, lambda d: d.curvature) > 0.25
