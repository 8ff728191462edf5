"""Records, signals, physics and rules. Light: a sandboxed worker imports it.

Reading problems from disk lives in `asia.problem.load`.
"""

from asia.problem._types import (
    Array,
    Bounds,
    Budget,
    EarlyStopping,
    FoldRule,
    Group,
    Metric,
    OutputGroup,
    ParameterRange,
    Physics,
    ProtocolRule,
    Signal,
    TestMetric,
    TestRule,
    Trajectory,
)

__all__ = [
    "Array",
    "Bounds",
    "Budget",
    "EarlyStopping",
    "FoldRule",
    "Group",
    "Metric",
    "OutputGroup",
    "ParameterRange",
    "Physics",
    "ProtocolRule",
    "Signal",
    "TestMetric",
    "TestRule",
    "Trajectory",
]
