"""Training methods: Adam for networks, Levenberg-Marquardt for models with few parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.errors import UserError
from asia.models._lm import LevenbergMarquardt

__all__ = ["Adam", "LevenbergMarquardt"]


@dataclass(frozen=True)
class Adam:
    """First-order training on the simulation error, with decoupled weight decay.

    steps: updates; schedule: learning rate held, or lowered to zero along a half cosine;
    clip: largest norm of the gradient; noise: standard deviation of white noise added to the
    z-scored inputs in training; truncation: None simulates whole records, a number cuts chunks of
    so many samples at random places, each started from its own past window; washout: samples at
    the start of a chunk that do not count; holdout: fraction of the training samples, in blocks
    from all over the records, that picks the number of steps before a refit on everything.
    Sources: Kingma and Ba, ICLR 2015; Loshchilov and Hutter, ICLR 2019; Beintema et al.,
    Automatica 156 (2023), for the chunks.
    """

    steps: int = 2000
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    schedule: Literal["cosine", "constant"] = "cosine"
    clip: float = 1.0
    noise: float = 0.0
    truncation: int | None = None
    washout: int = 0
    holdout: float = 0.0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.learning_rate <= 0 or self.clip <= 0:
            raise UserError("Adam: steps, learning_rate and clip must be positive")
        if self.truncation is not None and not 0 <= self.washout < self.truncation:
            raise UserError("Adam: truncation must be longer than washout")
        if not 0 <= self.holdout < 0.9:
            raise UserError(f"Adam: holdout is {self.holdout}, expected a fraction in [0, 0.9)")
