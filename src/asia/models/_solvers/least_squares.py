"""Training methods of the families that need no iteration on the simulation error."""

from __future__ import annotations

from dataclasses import dataclass

from asia.models._config import check_at_least


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
