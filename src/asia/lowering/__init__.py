"""Fitted models as small programs of a closed set of operations, the source of every export.

model = lowered(step_model, n_past_u, n_past_y, nu, ny)
y_hat = simulate(model, past_u, past_y, u)
"""

from asia.lowering.evaluate import evaluate, operations, simulate
from asia.lowering.ops import OPERATIONS, Shape, ShapeError
from asia.lowering.program import Builder, LoweredModel, Node, Program
from asia.lowering.wire import LARGEST_BYTES, FormatError, pack, unpack, unpack_for

__all__ = [
    "LARGEST_BYTES",
    "OPERATIONS",
    "Builder",
    "FormatError",
    "LoweredModel",
    "Node",
    "Program",
    "Shape",
    "ShapeError",
    "evaluate",
    "operations",
    "pack",
    "simulate",
    "unpack",
    "unpack_for",
]
