"""Checks between the steps of a fit: the log, scores, early stopping, the plateau rule."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from asia.candidate import VALIDATION_SCORES
from asia.models._config import Progress
from asia.models._networks.structure import Params
from asia.models.methods import LBFGS, Adam, MultipleShooting, NetworkMethod

_REPORTS = 25
_FACTOR, _THRESHOLD, _LOWEST = 0.5, 1e-4, 1e-5

Scorer = Callable[[Params], float]
"""Score of parameters: lower is better; not finite counts as worst."""


def marks(method: NetworkMethod, steps: int) -> list[int]:
    """Numbers of steps after which a fit is checked, the last one being `steps`.

    A check comes every `every` steps where a rule of the method counts checks, or as often as
    validation scores are permitted, else 25 times in the whole.
    """
    if method.stop is not None or _plateau(method):
        allowed = max(1, VALIDATION_SCORES // method.members - 1)
        every = max(method.every, -(-method.steps // allowed))
        found = set(range(every, method.steps, every)) | {method.steps}
    else:
        found = {round(method.steps * (i + 1) / _REPORTS) for i in range(_REPORTS)} - {0}
    return sorted({min(mark, steps) for mark in found})


@dataclass
class Plateau:
    """Rule that lowers the learning rate when a score has stopped improving.

    It is ReduceLROnPlateau of PyTorch with factor 0.5, relative threshold 1e-4 and lowest rate
    1e-5.
    """

    rate: float
    patience: int
    best: float = float("inf")
    waited: int = 0

    def __call__(self, score: float) -> float:
        """Return the learning rate after this score."""
        if score < self.best * (1.0 - _THRESHOLD):
            self.best, self.waited = score, 0
        else:
            self.waited += 1
        if self.waited > self.patience:
            self.rate, self.waited = max(self.rate * _FACTOR, min(_LOWEST, self.rate)), 0
        return self.rate


@dataclass
class Monitor:
    """Check that a fit calls after the steps of `marks`; it collects scores and decides how to go
    on.

    Args:
        score: score of parameters; None to run all steps.
        patience: checks without improvement before stopping; None never to stop.
        replay: learning rates of an earlier run to repeat.
    """

    method: NetworkMethod
    log: Progress
    score: Scorer | None = None
    patience: int | None = None
    replay: Sequence[float] = ()
    best: Params | None = None
    best_step: int = 0
    best_score: float = float("inf")
    rates: list[float] = field(default_factory=list[float])
    stopped: bool = False

    def __post_init__(self) -> None:
        self._plateau = _plateau(self.method)
        self._waited = 0

    @property
    def rate(self) -> float:
        """Learning rate of the next steps; of a cosine, its largest."""
        if self._plateau is not None:
            return self._plateau.rate
        return 1.0 if isinstance(self.method, LBFGS) else self.method.learning_rate

    def start(self, params: Params) -> None:
        """Score the initial parameters: fitted equations may be better than anything after."""
        if self.score is not None:
            value = self.score(params)
            self._keep(0, params, value if np.isfinite(value) else float("inf"))

    def __call__(self, step: int, params: Callable[[], Params], loss: float) -> None:
        """Check the fit after a step.

        Args:
            step: number of the step.
            params: called for the parameters only when they are needed.
            loss: mean training loss since the last check.
        """
        if np.isfinite(loss):
            self.log(step, float(np.sqrt(loss)) if self.method.loss == "mse" else loss)
        value = loss
        if self.score is not None:
            current = params()
            value = self.score(current)
            value = value if np.isfinite(value) else float("inf")
            self._keep(step, current, value)
        if self._plateau is not None:
            self._plateau(value)
            index = len(self.rates)
            if index < len(self.replay):
                self._plateau.rate = self.replay[index]
        self.rates.append(self.rate)

    def _keep(self, step: int, params: Params, value: float) -> None:
        if value < self.best_score or self.best is None:
            self.best, self.best_step, self.best_score, self._waited = params, step, value, 0
        else:
            self._waited += 1
        self.stopped = self.patience is not None and self._waited >= self.patience


def _plateau(method: NetworkMethod) -> Plateau | None:
    if isinstance(method, Adam | MultipleShooting) and method.schedule == "plateau":
        return Plateau(method.learning_rate, method.plateau_patience)
    return None
