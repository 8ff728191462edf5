"""How a model is judged: folds, past windows, horizon, metric."""

from asia.protocol._folds import Block, Case, Fold, cut, make_folds, whole
from asia.protocol._rules import (
    EarlyStopping,
    Feedback,
    FoldRule,
    Group,
    Metric,
    OutputGroup,
    ProtocolRule,
    TestMetric,
    TestRule,
)

__all__ = [
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
    "TestMetric",
    "TestRule",
    "cut",
    "make_folds",
    "whole",
]
