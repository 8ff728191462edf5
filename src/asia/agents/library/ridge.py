"""Moves on the ridge that holds a model's weights near zero."""

from __future__ import annotations

from collections.abc import Callable

from asia.agents.library.evidence import by_overfit, overfit
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe

Scaled = Callable[[Situation, float], Recipe]


def scaled_ridge(at: Situation, factor: float) -> Recipe:
    """The setting `ridge` times a factor."""
    return at.recipe.times("ridge", factor, 1e-5)


def more_ridge(what: str = "weights", scaled: Scaled = scaled_ridge) -> Move:
    """Make the move that multiplies the ridge by ten.

    Args:
        what: the regularised part of the model
    """
    return Move(
        name="more ridge",
        weight=lambda c: by_overfit(c.trial, 0.75, 0.45, 0.1),
        change=lambda c: scaled(c, 10.0),
        hypothesis=f"V is well above the training error: the {what} follow their own fold.",
        expected="A slightly higher training error and a lower V.",
    )


def much_more_ridge() -> Move:
    """Thirty times the ridge."""
    return Move(
        name="much more ridge",
        weight=lambda c: by_overfit(c.trial, 0.85, 0.5, 0.1),
        change=lambda c: scaled_ridge(c, 30.0),
        hypothesis=(
            "V is well above the training error: the nonlinear weights overfit their fold, or "
            "diverge outside it."
        ),
        expected="A higher training error and a lower V.",
    )


def less_ridge(scaled: Scaled = scaled_ridge) -> Move:
    """A tenth of the ridge."""
    return Move(
        name="less ridge",
        weight=lambda c: 0.5 if overfit(c.trial) < 1.3 else 0.15,
        change=lambda c: scaled(c, 0.1),
        hypothesis="V is near the training error: the priors are too strong.",
        expected="Lower training error, V follows.",
    )
