"""Training methods. Networks: Adam, LBFGS, MultipleShooting; models with few parameters:
Levenberg-Marquardt.

    method = Adam(steps=2000, learning_rate=3e-3, truncation=100, holdout=0.2)
    model = lstm.train(lstm.build(config, context), trajectories, context, method)
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from asia.errors import UserError
from asia.models._config import check_at_least, check_choice, demand, owner
from asia.models._least_squares import LevenbergMarquardt
from asia.models._noise.model import NoiseChoice, NoiseKind, check_noise

__all__ = [
    "LBFGS",
    "Adam",
    "LeastSquares",
    "LevenbergMarquardt",
    "MultipleShooting",
    "NetworkMethod",
]

Loss = Literal["mse", "mae", "huber"]
Schedule = Literal["cosine", "constant", "plateau"]


@dataclass(frozen=True)
class LeastSquares:
    """Linear least squares, for families that are linear in their parameters."""

    ridge: float | None = None
    """Weight of the squared parameters against the mean squared error in z-scores; None chooses it
    inside the training data by the simulation error on segments left out."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "ridge")


@dataclass(frozen=True, kw_only=True)
class _NetworkFit:
    """Settings of a network fit for held-out samples and stopping."""

    holdout: float = 0.0
    """Share of the training samples, in [0, 0.9), that picks the number of steps before a refit on
    everything: blocks from all over the records or, of four records or more, whole ones."""
    members: int = 1
    """Networks from different seeds, whose simulations are averaged."""
    stop: Literal["validation"] | None = None
    """"validation" keeps the parameters with the least `context.validation_score`; without such a
    score it takes the held-out part, and without one all steps run."""
    every: int = 25
    """Steps between two such checks."""
    patience: int = 20
    """Checks in a row without improvement after which the fit stops."""
    symmetry: bool = False
    """Fit the records under every symmetry of the problem that takes inputs to
    inputs and outputs to outputs, and average simulations over these."""
    noise_model: NoiseKind = "white"
    """Model of the residual of a simulation: "white", or "slow" for a slow disturbance
    plus white noise, see `LevenbergMarquardt`. The first half of the steps is fitted without it;
    from there the sizes of both parts are estimated. Simulated chunks are whitened separately.
    Not for `MultipleShooting`."""
    huber: float | None = None
    """Threshold, in deviations of the innovations, beyond which their loss grows in proportion to
    them; None is least squares. Beside it or a noise model `loss` must be "mse"."""


@dataclass(frozen=True)
class Adam(_NetworkFit):
    """First-order training on the simulation error in z-scores.

    A step sees whole records, windows of the problem's horizon, or chunks of `truncation` samples,
    each of which starts at a random place from its own past window (truncated back-propagation
    through time).

    Sources: Kingma and Ba, ICLR 2015; Loshchilov and Hutter, ICLR 2019 (weight decay); Beintema et
    al., Automatica 156, 2023 (chunks); Bengio et al., NeurIPS 2015 (scheduled sampling); Gal and
    Ghahramani, NeurIPS 2016 (dropout).
    """

    steps: int = 2000
    """Updates."""
    learning_rate: float = 1e-3
    """Learning rate at the first step."""
    weight_decay: float = 1e-4
    """Decay of the weights at each step, times the learning rate; see `coupled`."""
    schedule: Schedule = "cosine"
    """The learning rate is lowered to zero along a half cosine, held ("constant"), or halved down
    to 1e-5 when the score no longer improves ("plateau")."""
    clip: float = 1.0
    """Largest norm of the gradient; a larger one is scaled down."""
    noise: float = 0.0
    """Standard deviation of white noise added to the z-scored inputs."""
    truncation: int | None = None
    """Samples of a chunk; None simulates whole records, or windows of the problem's horizon."""
    batch: int | None = None
    """Chunks of a step; None: as many as cover the records once, but at most 128."""
    full_batch: bool = False
    """Use all chunks in every step, laid end to end."""
    loss: Loss = "mse"
    """Mean of squares, "mse", of absolute values, "mae", or Huber's with its bend at 1, "huber"."""
    horizons: tuple[int, ...] | None = None
    """The loss is the mean, over these numbers h, of that of the first h samples, which weighs
    early samples more; None: that of all samples."""
    dropout: float = 0.0
    """Share of the features set to zero, the same ones for a whole simulation."""
    teacher: float = 0.0
    """Probability at the first step that a cell which feeds back its own output is fed the measured
    one (scheduled sampling); 1, with `teacher_end` 1, is teacher forcing."""
    teacher_end: float = 0.0
    """Probability of a measured output at the last step; it changes linearly from `teacher`."""
    average: float = 0.0
    """Decay of an exponential moving average of the weights that is returned in their place; 0:
    none."""
    plateau_patience: int = 2
    """Number of checks in a row, with schedule "plateau", that may fail to improve the score by a
    factor of 1 - 1e-4 before the rate is halved."""
    coupled: bool = False
    """Make the decay part of the gradient (Adam with an L2 penalty) instead of a separate step
    (AdamW)."""
    gentle: float = 0.0
    """Chunks at random places are drawn in proportion to their amplitude to the power -gentle: the
    root mean square, over a chunk, of the outputs' increments in standard deviations."""
    offset: float = 0.0
    """Standard deviation of a constant, drawn for each chunk, added to each z-scored input."""

    def __post_init__(self) -> None:
        _check_optimiser(self)
        _check_fit(self, self.truncation)
        least = 1 if self.horizons is None else min(self.horizons, default=0)
        demand(self, "horizons", least >= 1, "numbers of samples, each at least 1")
        for name in ("noise", "gentle", "offset"):
            demand(self, name, getattr(self, name) >= 0, "0 or more")
        demand(self, "dropout", 0 <= self.dropout < 1, "a share in [0, 1)")
        demand(self, "average", 0 <= self.average < 1, "a decay in [0, 1)")
        demand(self, "teacher", 0 <= self.teacher <= 1, "a probability")
        demand(self, "teacher_end", 0 <= self.teacher_end <= 1, "a probability")
        demand(self, "batch", self.batch is None or self.batch >= 1, "None or at least 1")
        if self.full_batch and self.batch is not None:
            raise UserError("Adam: full_batch takes every chunk in each step; leave batch out")


@dataclass(frozen=True)
class LBFGS(_NetworkFit):
    """Limited-memory BFGS on all samples at once, in double precision: many digits for small
    networks and short records, where Adam crawls along narrow valleys.

    Source: Byrd et al., SIAM Journal on Scientific Computing 16(5), 1995.
    """

    steps: int = 500
    """Iterations."""
    memory: int = 20
    """Pairs of vectors kept."""
    ridge: float = 1e-6
    """Weight, against the loss, of the sum of squares of all weight matrices."""
    truncation: int | None = None
    """Samples of a chunk, laid end to end; None simulates whole records, or windows of the
    problem's horizon."""
    loss: Loss = "mse"
    """Mean of squares, "mse", or Huber's with its bend at 1, "huber": those with a gradient
    everywhere."""

    def __post_init__(self) -> None:
        _check_fit(self, self.truncation)
        demand(self, "memory", self.memory >= 1, "at least 1")
        demand(self, "ridge", self.ridge >= 0, "0 or more")
        if self.loss == "mae":
            raise UserError("LBFGS: loss 'mae' has no gradient at zero; take 'mse' or 'huber'")


@dataclass(frozen=True)
class MultipleShooting(_NetworkFit):
    """Adam on the parameters together with the initial states of short segments, for cells.

    Each record is cut into segments of `length` samples. A segment's initial state is free and
    starts from the network's map of its past window; the squared distance between the end of
    a segment and the start of the next is added to the loss with a weight that grows in equal
    ratios. Short segments keep gradients from exploding, so that systems are learned whose
    simulation from a bad start diverges or has no useful gradient. The map from the past window to
    the initial state is fitted to the free states on the way.
    Sources: Bock, 1981; Ribeiro et al., Automatica 121, 2020; Turan and Jaeschke, IEEE Control
    Systems Letters 6, 2022.
    """

    steps: int = 2000
    """Updates."""
    learning_rate: float = 3e-3
    """Learning rate at the first step."""
    weight_decay: float = 0.0
    """Decay of the weights at each step, times the learning rate."""
    schedule: Schedule = "cosine"
    """Schedule of the learning rate, as in `Adam`."""
    clip: float = 1.0
    """Largest norm of a gradient; a larger one is scaled down."""
    length: int = 30
    """Samples of a segment, at least 2."""
    penalty: float = 10.0
    """Weight of the squared distances at the last step."""
    penalty_start: float = 0.1
    """Weight of the squared distances at the first step."""
    loss: Loss = "mse"
    """Mean of squares, "mse", of absolute values, "mae", or Huber's with its bend at 1, "huber"."""
    plateau_patience: int = 2
    """Number of checks in a row, with schedule "plateau", that may fail to improve the score by a
    factor of 1 - 1e-4 before the rate is halved."""

    def __post_init__(self) -> None:
        _check_optimiser(self)
        _check_fit(self)
        if NoiseChoice.of(self) is not None:
            raise UserError(
                "MultipleShooting: free starts of segments take up a slow disturbance; give "
                "noise_model or huber to Adam or LBFGS"
            )
        demand(self, "length", self.length >= 2, "at least 2 samples")
        demand(self, "penalty", self.penalty > 0, "a positive weight")
        demand(self, "penalty_start", self.penalty_start > 0, "a positive weight")

    @property
    def optimiser(self) -> Adam:
        """Update rule of a step."""
        return Adam(
            self.steps, self.learning_rate, self.weight_decay, self.schedule, self.clip,
            loss=self.loss,
        )  # fmt: skip


NetworkMethod: TypeAlias = Adam | LBFGS | MultipleShooting


def _check_optimiser(m: Adam | MultipleShooting) -> None:
    demand(m, "learning_rate", m.learning_rate > 0, "a positive number")
    demand(m, "weight_decay", m.weight_decay >= 0, "0 or more")
    demand(m, "clip", m.clip > 0, "a positive number")
    check_choice(m, "schedule", get_args(Schedule))
    demand(m, "plateau_patience", m.plateau_patience >= 0, "0 checks or more")


def _check_fit(m: NetworkMethod, truncation: int | None = None) -> None:
    check_at_least(1, m, "steps", "members", "every", "patience")
    check_noise(m)
    if NoiseChoice.of(m) is not None and m.loss != "mse":
        raise UserError(
            f"{owner(m)}: loss is {m.loss!r} beside a noise model, expected 'mse'; huber makes the "
            "loss of innovations robust"
        )
    demand(m, "holdout", 0 <= m.holdout < 0.9, "a fraction in [0, 0.9)")
    demand(m, "stop", m.stop in (None, "validation"), "None or 'validation'")
    check_choice(m, "loss", get_args(Loss))
    if truncation is not None:
        demand(m, "truncation", truncation >= 1, "None or at least 1")
