"""The rule for the model to use. It knows training data alone; docs/design/model-to-use.md says why
it is as it is."""

from __future__ import annotations

from asia.ledger import ModelToUse, Stack, error_value
from asia.search.final.refit import CheckedRefit

# Of the winner's V: a stack is used only where its nested V is below.
STACK_GAIN = 0.9


def choose_model(value: float, refit: CheckedRefit, stack: Stack | None) -> ModelToUse:
    """The model to use. value: V of the winner."""
    if stack is not None and stack.value < STACK_GAIN * value:
        return ModelToUse(
            "stack",
            f"Its V by nested cross-validation, {error_value(stack.value)}, is clearly below the "
            f"winner's, {error_value(value)}.",
        )
    if refit.model is None or refit.check is None:
        return ModelToUse("ensemble", f"There is no refit worth using: {refit.detail}.")
    error = refit.check.starts[-1].error
    assert error is not None
    return ModelToUse(
        "refit",
        f"It is fitted on all training records and its error there is {error_value(error)}.",
    )
