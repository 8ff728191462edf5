"""(y, y_hat) -> Score or Failure. Sees targets, never runs a candidate."""

from asia.scoring._diagnostics import Diagnostics, diagnose
from asia.scoring._mee import GroupError, MeeTable, mee_table
from asia.scoring._metrics import METRICS, fit_index, mae, r2, rmse
from asia.scoring._outcome import (
    Failure,
    FoldScore,
    Outcome,
    Score,
    TestScore,
    check_reply,
    combine,
    score_fold,
    score_test,
)

__all__ = [
    "METRICS",
    "Diagnostics",
    "Failure",
    "FoldScore",
    "GroupError",
    "MeeTable",
    "Outcome",
    "Score",
    "TestScore",
    "check_reply",
    "combine",
    "diagnose",
    "fit_index",
    "mae",
    "mee_table",
    "r2",
    "rmse",
    "score_fold",
    "score_test",
]
