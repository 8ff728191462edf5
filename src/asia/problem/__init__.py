"""What a search is about: the problem, its physics and its budget. Light: a sandboxed worker
imports it.

Reading problems from disk lives in `asia.problem.load`.
"""

from asia.data import Array, Signal, Trajectory
from asia.problem._budget import Budget
from asia.problem.physics.types import Bounds, Correction, ParameterRange, Physics, Prior

__all__ = [
    "Array",
    "Bounds",
    "Budget",
    "Correction",
    "ParameterRange",
    "Physics",
    "Prior",
    "Signal",
    "Trajectory",
]
