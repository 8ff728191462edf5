"""The rule for the model to use. It knows training data alone; docs/design/model-to-use.md says why
it is as it is."""

from __future__ import annotations

from dataclasses import dataclass

from asia.ledger import Experiment, ModelToUse, RefitCheck, Refitted, Stack, error_value
from asia.search.final.refit import is_as_good, is_worthy

# Maximum nested V of a stack, relative to the winner's V.
STACK_GAIN = 0.8


@dataclass(frozen=True)
class FinalEvidence:
    """Evidence for the choice of the model to use."""

    value: float
    """V of the winner."""
    folds: tuple[float, ...]
    """Its part of each fold."""
    train_errors: tuple[float, ...]
    """The error of each of its fold models on what that was fitted on."""
    check: RefitCheck | None
    """The comparison of the refit with the fold models; None where there is none."""
    detail: str
    """Why there is no refit; "" where there is one."""
    stack: Stack | None
    """The stack."""

    @staticmethod
    def of(best: Experiment, refitted: Refitted) -> FinalEvidence:
        """Return the evidence from the winner and the end of its search."""
        assert best.score is not None
        assert best.result is not None
        return FinalEvidence(
            value=best.score.value,
            folds=tuple(fold.value for fold in best.score.folds),
            train_errors=tuple(fold.diagnostics.train_error for fold in best.result.folds),
            check=refitted.check,
            detail=refitted.detail if refitted.model is None else "",
            stack=refitted.stack,
        )


def choose_model(evidence: FinalEvidence) -> ModelToUse:
    """The model to use."""
    value, stack, check = evidence.value, evidence.stack, evidence.check
    if stack is not None and stack.value < STACK_GAIN * value:
        return ModelToUse(
            "stack",
            f"Its V by nested cross-validation, {error_value(stack.value)}, is clearly below the "
            f"winner's, {error_value(value)}.",
        )
    if evidence.detail or check is None:
        why = evidence.detail or "there is no refit"
        return ModelToUse("ensemble", f"{why[:1].upper()}{why[1:]}.")
    kept = check.starts[(check.kept or 0) - 1]
    errors = f"{_error_text(kept.error)}, that of the ensemble {_error_text(check.ensemble_error)}"
    if is_worthy(check):
        text = f"It is fitted on all training records; its error there is {errors}."
        return ModelToUse("refit", text)
    if is_as_good(check):
        text = f"{_error_text(kept.disagreement)} against {_error_text(check.fold_disagreement)}"
        return ModelToUse(
            "ensemble",
            "The refit differs from the fold models by more than they differ from each other: "
            f"{text} standard deviations.",
        )
    return ModelToUse("ensemble", f"The refit's error on its own training records is {errors}.")


def _error_text(error: float | None) -> str:
    return "none" if error is None else error_value(error)
