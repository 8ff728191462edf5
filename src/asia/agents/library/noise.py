"""The noise model of a fit: what may be varied, and the move that sets it."""

from __future__ import annotations

from asia.agents._view import Facts
from asia.agents.library.evidence import coloured
from asia.agents.library.move import Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import OneOf, Parameter


def noise_space(facts: Facts, *, with_loss: bool = False) -> tuple[Parameter, ...]:
    """Settings of a training method where whole records are simulated: windows are too short to
    tell a slow disturbance from their start. `with_loss`: the method has a loss, which must be the
    squared error."""
    if facts.horizon is not None:
        return ()
    needs, being = ("loss", "mse") if with_loss else ("", None)
    return (OneOf("noise_model", ("white", "slow"), needs=needs, being=being),)


def has_noise_model(recipe: Recipe) -> bool:
    """Whether the fit takes a slow disturbance into account."""
    return recipe.get("noise_model") == "slow"


def _weight(at: Situation) -> float:
    if has_noise_model(at.recipe):
        return 0.0
    if not at.varies("noise_model") or at.recipe.get("loss") not in (None, "mse"):
        return 0.0
    return 0.7 if coloured(at.trial) else 0.15


def slow_noise() -> Move:
    """Generalised least squares in place of least squares."""
    return Move(
        name="slow disturbance in the noise",
        weight=_weight,
        change=lambda c: c.recipe.trained(noise_model="slow"),
        hypothesis="The training residual is not white: a slow disturbance that no input shows is "
        "part of the output, and least squares bends the model to follow it. Generalised least "
        "squares does not.",
        expected="A higher training error and a lower V, with parameters that agree between folds.",
    )
