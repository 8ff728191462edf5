"""Training methods. Networks: Adam, LBFGS, MultipleShooting; models with few parameters:
Levenberg-Marquardt.

    method = Adam(steps=2000, learning_rate=3e-3, truncation=100, holdout=0.2)
    model = lstm.train(lstm.build(config, context), trajectories, context, method)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from asia.errors import UserError
from asia.models._solvers.least_squares import LeastSquares, MarginalLikelihood
from asia.models._solvers.levenberg_marquardt import LevenbergMarquardt

__all__ = [
    "LBFGS",
    "Adam",
    "LeastSquares",
    "LevenbergMarquardt",
    "MarginalLikelihood",
    "MultipleShooting",
    "NetworkMethod",
]

Loss = Literal["mse", "mae", "huber"]
Schedule = Literal["cosine", "constant", "plateau"]


@dataclass(frozen=True)
class Adam:
    """First-order training on the simulation error in z-scores.

    The optimiser. steps: updates, at learning_rate; weight_decay: apart from the gradient (AdamW),
    or with coupled part of it (plain Adam with an L2 penalty); schedule: that rate lowered to zero
    along a half cosine, held, or halved (`plateau`, down to 1e-5) when more than plateau_patience
    checks in a row have not improved the score by a factor of 1 - 1e-4; clip: largest norm of the
    gradient; average: decay of an exponential moving average of the weights that is returned in
    their place, 0 for none.

    What a step sees. truncation: None simulates whole records, or windows of the problem's
    horizon where it has one; a number cuts chunks of so many samples. A chunk starts at a random
    place from its own past window; batch: chunks a step, None for as many as cover the records
    once, but at most 128. full_batch: every step sees all chunks, laid end to end. carry: chunks
    in time order, the state carried over and the gradient cut between them (truncated
    back-propagation through time); batch is then the number of stretches read in parallel, None
    for one a record.

    The loss. loss: mean of squares, of absolute values, or Huber's with its bend at 1; washout:
    samples at the start of a simulation that do not count; horizons: the mean of the losses over
    the first h samples for each h, to weigh early samples more; noise: standard deviation of white
    noise added to the z-scored inputs; dropout: share of the features set to zero, the same ones
    for a whole simulation; teacher, teacher_end: probability, at the first step and linearly to
    the last, that a cell which feeds back its own output is fed the measured one (scheduled
    sampling; 1 and 1 for teacher forcing).

    When to stop. holdout: fraction of the training samples, blocks from all over the records or,
    of four records or more, whole ones, that picks the number of steps before a refit on
    everything; stop: "validation" asks `context.validation_score` every `every` steps, stops after
    `patience` checks without improvement and keeps the best parameters. Where there is no such
    score it takes the held-out part with the same patience, and without one runs all steps.
    members: networks from different seeds whose simulations are averaged.

    Sources: Kingma and Ba, ICLR 2015; Loshchilov and Hutter, ICLR 2019 (weight decay); Beintema et
    al., Automatica 156, 2023 (chunks); Bengio et al., NeurIPS 2015 (scheduled sampling); Gal and
    Ghahramani, NeurIPS 2016 (dropout).
    """

    steps: int = 2000
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    schedule: Schedule = "cosine"
    clip: float = 1.0
    noise: float = 0.0
    truncation: int | None = None
    washout: int = 0
    holdout: float = 0.0
    batch: int | None = None
    full_batch: bool = False
    carry: bool = False
    loss: Loss = "mse"
    horizons: tuple[int, ...] | None = None
    dropout: float = 0.0
    teacher: float = 0.0
    teacher_end: float = 0.0
    average: float = 0.0
    members: int = 1
    stop: Literal["validation"] | None = None
    every: int = 25
    patience: int = 20
    plateau_patience: int = 2
    coupled: bool = False

    def __post_init__(self) -> None:
        _check_optimiser(self)
        _check_fit(self)
        _check_loss(self.loss, self.truncation, self.washout, "Adam")
        _check_horizons(self.horizons, self.washout)
        _demand("Adam", "noise", self.noise, self.noise >= 0, "0 or more")
        _demand("Adam", "dropout", self.dropout, 0 <= self.dropout < 1, "a share in [0, 1)")
        _demand("Adam", "average", self.average, 0 <= self.average < 1, "a decay in [0, 1)")
        for name, value in (("teacher", self.teacher), ("teacher_end", self.teacher_end)):
            _demand("Adam", name, value, 0 <= value <= 1, "a probability")
        _demand("Adam", "batch", self.batch, _at_least_1(self.batch), "None or at least 1")
        if self.carry and (self.full_batch or self.truncation is None):
            raise UserError(
                "Adam: carry reads the records in chunks of `truncation` samples; give truncation "
                "and leave full_batch out"
            )
        if self.full_batch and self.batch is not None:
            raise UserError("Adam: full_batch takes every chunk in each step; leave batch out")


@dataclass(frozen=True)
class LBFGS:
    """Limited-memory BFGS on all samples at once, in double precision: many digits for small
    networks and short records, where Adam crawls along narrow valleys.

    steps: iterations; memory: pairs of vectors kept; ridge: weight, against the loss, of the sum
    of squares of all weight matrices; truncation: None simulates whole records, or windows of the
    problem's horizon, a number cuts chunks laid end to end; loss ("mse" or "huber", which have a
    gradient everywhere), washout, holdout, members, stop, every and patience as in `Adam`.
    Source: Byrd et al., SIAM Journal on Scientific Computing 16(5), 1995.
    """

    steps: int = 500
    memory: int = 20
    ridge: float = 1e-6
    truncation: int | None = None
    loss: Loss = "mse"
    washout: int = 0
    holdout: float = 0.0
    members: int = 1
    stop: Literal["validation"] | None = None
    every: int = 25
    patience: int = 20

    def __post_init__(self) -> None:
        _check_fit(self)
        _check_loss(self.loss, self.truncation, self.washout, "LBFGS")
        _demand("LBFGS", "memory", self.memory, self.memory >= 1, "at least 1")
        _demand("LBFGS", "ridge", self.ridge, self.ridge >= 0, "0 or more")
        if self.loss == "mae":
            raise UserError("LBFGS: loss 'mae' has no gradient at zero; take 'mse' or 'huber'")


@dataclass(frozen=True)
class MultipleShooting:
    """Adam on the parameters together with the initial states of short segments, for cells.

    Each record is cut into segments of `length` samples. A segment's initial state is free and
    starts from what the network makes of its past window; the squared distance between the end of
    a segment and the start of the next is added to the loss with a weight that grows from
    penalty_start to penalty in equal ratios. Short segments keep gradients from exploding, so that
    systems are learned whose simulation from a bad start diverges or says nothing. The map from
    the past window to the initial state is fitted to the free states on the way. steps,
    learning_rate, weight_decay, schedule, clip, loss, holdout, members, stop, every, patience and
    plateau_patience as in `Adam`.
    Sources: Bock, 1981; Ribeiro et al., Automatica 121, 2020; Turan and Jaeschke, IEEE Control
    Systems Letters 6, 2022.
    """

    steps: int = 2000
    learning_rate: float = 3e-3
    weight_decay: float = 0.0
    schedule: Schedule = "cosine"
    clip: float = 1.0
    length: int = 30
    penalty: float = 10.0
    penalty_start: float = 0.1
    loss: Loss = "mse"
    holdout: float = 0.0
    members: int = 1
    stop: Literal["validation"] | None = None
    every: int = 25
    patience: int = 20
    plateau_patience: int = 2

    def __post_init__(self) -> None:
        name = "MultipleShooting"
        _check_optimiser(self)
        _check_fit(self)
        _check_loss(self.loss, None, 0, name)
        _demand(name, "length", self.length, self.length >= 2, "at least 2 samples")
        for field, value in (("penalty", self.penalty), ("penalty_start", self.penalty_start)):
            _demand(name, field, value, value > 0, "a positive weight")

    @property
    def optimiser(self) -> Adam:
        """The update rule."""
        return Adam(
            self.steps, self.learning_rate, self.weight_decay, self.schedule, self.clip,
            loss=self.loss,
        )  # fmt: skip


NetworkMethod: TypeAlias = Adam | LBFGS | MultipleShooting


def _demand(method: str, field: str, value: object, holds: bool, expected: str) -> None:
    if not holds:
        raise UserError(f"{method}: {field} is {value!r}, expected {expected}")


def _at_least_1(value: int | None) -> bool:
    return value is None or value >= 1


def _check_optimiser(m: Adam | MultipleShooting) -> None:
    name = type(m).__name__
    _demand(name, "learning_rate", m.learning_rate, m.learning_rate > 0, "a positive number")
    _demand(name, "weight_decay", m.weight_decay, m.weight_decay >= 0, "0 or more")
    _demand(name, "clip", m.clip, m.clip > 0, "a positive number")
    known = get_args(Schedule)
    _demand(name, "schedule", m.schedule, m.schedule in known, f"one of {', '.join(known)}")
    waits = m.plateau_patience
    _demand(name, "plateau_patience", waits, waits >= 0, "0 checks or more")


def _check_fit(m: NetworkMethod) -> None:
    name = type(m).__name__
    for field, value in (
        ("steps", m.steps),
        ("members", m.members),
        ("every", m.every),
        ("patience", m.patience),
    ):
        _demand(name, field, value, value >= 1, "at least 1")
    _demand(name, "holdout", m.holdout, 0 <= m.holdout < 0.9, "a fraction in [0, 0.9)")
    _demand(name, "stop", m.stop, m.stop in (None, "validation"), "None or 'validation'")


def _check_loss(loss: Loss, truncation: int | None, washout: int, name: str) -> None:
    known = get_args(Loss)
    _demand(name, "loss", loss, loss in known, f"one of {', '.join(known)}")
    _demand(name, "truncation", truncation, _at_least_1(truncation), "None or at least 1")
    _demand(name, "washout", washout, washout >= 0, "0 samples or more")
    if truncation is not None and washout >= truncation:
        raise UserError(
            f"{name}: washout is {washout}, expected less than truncation ({truncation}): "
            "no sample of a chunk would count"
        )


def _check_horizons(horizons: tuple[int, ...] | None, washout: int) -> None:
    if horizons is None:
        return
    if not horizons or min(horizons) <= washout:
        raise UserError(
            f"Adam: horizons is {horizons!r}, expected sample counts that are all above washout "
            f"({washout})"
        )
