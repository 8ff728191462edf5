"""How a model is judged: folds, past windows, horizon, metric."""

from asia.protocol._folds import Block, Case, Fold, cut, fold_names, make_folds, whole
from asia.protocol._metrics import (
    MEE,
    METRICS,
    Metric,
    TrainingLoss,
    find_metric,
    known_metric,
    known_test_metric,
    metric_label,
    metric_names,
)
from asia.protocol._rules import (
    EarlyStopping,
    Feedback,
    FoldRule,
    Group,
    OutputGroup,
    ProtocolRule,
    ShownResidual,
    TestRule,
)

__all__ = [
    "MEE",
    "METRICS",
    "Block",
    "Case",
    "EarlyStopping",
    "Feedback",
    "Fold",
    "FoldRule",
    "Group",
    "Metric",
    "OutputGroup",
    "ProtocolRule",
    "ShownResidual",
    "TestRule",
    "TrainingLoss",
    "cut",
    "find_metric",
    "fold_names",
    "known_metric",
    "known_test_metric",
    "make_folds",
    "metric_label",
    "metric_names",
    "whole",
]
