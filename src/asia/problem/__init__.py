"""Problem, physics and budget of a search; light, because a sandboxed worker imports it.

Reading problems from disk lives in `asia.problem.load`.
"""

from asia.data.trajectory import Array, Signal, Trajectory
from asia.problem.budget import Budget
from asia.problem.physics import Bounds, Correction, ParameterRange, Physics, Prior

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
