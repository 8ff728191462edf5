"""Evaluation of candidates: folds, sandbox and scoring together.

This package holds targets and runs candidates, never both at once: a worker receives a `Case`, and
the scored outputs stay here.
"""

from asia.evaluation._context import search_context
from asia.evaluation._dry_run import DryFold, DryRun, allowed_seconds, dry_run, short_fold
from asia.evaluation._evaluator import Evaluator
from asia.evaluation._metamorphic import dependences, suspicions
from asia.evaluation._oracle import rounded_score
from asia.evaluation._relations import Suspicion, SuspicionKind
from asia.evaluation._requests import simulate_held_out, simulate_training
from asia.evaluation._results import (
    FAR_BELOW,
    Evaluation,
    FoldFindings,
    FoldResult,
    Refit,
    RefitModel,
    StepErrors,
    consistency,
    derive_seed,
    mean_simulation,
    same_simulations,
)
from asia.evaluation._rungs import LINEAR, LINEAR_RUNG, MEAN_RUNG, TRUTH, Rung, score_rungs
from asia.evaluation._training_checks import TrainingCheck
from asia.evaluation.work.background import BackgroundJob, JobSettings
from asia.evaluation.work.machines import MachineState, survey_machines

__all__ = [
    "FAR_BELOW",
    "LINEAR",
    "LINEAR_RUNG",
    "MEAN_RUNG",
    "TRUTH",
    "BackgroundJob",
    "DryFold",
    "DryRun",
    "Evaluation",
    "Evaluator",
    "FoldFindings",
    "FoldResult",
    "JobSettings",
    "MachineState",
    "Refit",
    "RefitModel",
    "Rung",
    "StepErrors",
    "Suspicion",
    "SuspicionKind",
    "TrainingCheck",
    "allowed_seconds",
    "consistency",
    "dependences",
    "derive_seed",
    "dry_run",
    "mean_simulation",
    "rounded_score",
    "same_simulations",
    "score_rungs",
    "search_context",
    "short_fold",
    "simulate_held_out",
    "simulate_training",
    "survey_machines",
    "suspicions",
]
