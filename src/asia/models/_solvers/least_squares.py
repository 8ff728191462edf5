"""Settings of the training methods of models with few parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.models._config import check_at_least, demand
from asia.models._noise.choice import NoiseKind, check_noise


@dataclass(frozen=True)
class LeastSquares:
    """Linear least squares, for families that are linear in their parameters."""

    ridge: float | None = None
    """Weight of the squared parameters against the mean squared error in z-scores; None chooses it
    inside the training data by the simulation error on stretches left out."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "ridge")


@dataclass(frozen=True)
class MarginalLikelihood:
    """Hyper-parameters of a Gaussian process by the evidence of its training data, with L-BFGS.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.
    """

    iterations: int = 60
    """Greatest number of steps for each output."""
    points: int = 400
    """Training points, spread over the records, that the evidence is computed on; its cost grows
    with their cube."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "iterations")
        check_at_least(2, self, "points")


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Training method: damped Gauss-Newton on the simulation error.

    Source: Marquardt, SIAM J. Appl. Math. 11 (1963).
    """

    iterations: int = 50
    """Greatest number of Jacobians."""
    starts: int = 1
    """Starting points, in families that can be started from several."""
    damping: float = 1e-2
    """First damping, relative to the scaled normal matrix."""
    tolerance: float = 1e-9
    """Relative decrease of the cost below which it stops."""
    stop: Literal["validation"] | None = None
    """"validation" keeps the parameters with the least `context.validation_score`, asked for after
    every iteration, in families that can (physics_net); without such a score, or elsewhere, the
    last ones are kept."""
    noise_model: NoiseKind = "white"
    """What the residual of a simulation is taken for: "white", or "slow" for a slow disturbance
    (Ornstein-Uhlenbeck) plus white noise. The sizes of both are estimated from the residuals of the
    fit by least squares, and generalised least squares goes on from there, in turn until they
    settle. Changes how a model is trained, not how it simulates."""
    slow_time: float | None = None
    """Time constant of the slow disturbance in s; None estimates it."""
    huber: float | None = None
    """Threshold, in deviations of the innovations, beyond which their cost grows in proportion to
    them; None is least squares."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "iterations", "tolerance")
        check_at_least(1, self, "starts")
        check_noise(self)
        demand(self, "damping", self.damping > 0, "a positive number")
        demand(self, "stop", self.stop in (None, "validation"), "None or 'validation'")
