"""Messages of the parent about a failed worker.

Once a worker knows cases, its own words could contain them: only the messages in this module are
passed on.
"""

from __future__ import annotations

import builtins

import numpy as np

from asia._text import printable
from asia.errors import Reason
from asia.sandbox.worker.wire import SHAPE_DIMENSIONS, ReplyKind

REASONS = {
    ReplyKind.SYNTAX: Reason.SYNTAX,
    ReplyKind.CONTRACT: Reason.CONTRACT,
    ReplyKind.CRASH: Reason.CRASH,
    ReplyKind.EXITED: Reason.EXITED,
    ReplyKind.MEMORY: Reason.MEMORY,
    ReplyKind.SHAPE: Reason.WRONG_LENGTH,
}
"""Reason of each reply that reports a failure."""
KNOWN_ERRORS = frozenset(
    name
    for name, value in vars(builtins).items()
    if isinstance(value, type) and issubclass(value, BaseException)
) | {"LinAlgError", "JaxRuntimeError", "XlaRuntimeError", "EquinoxRuntimeError", "UnpicklingError"}
OUT_OF_MEMORY = ("std::bad_alloc", "out of memory", "memory allocation", "cannot allocate memory")


def failure_words(
    status: ReplyKind, body: bytes, expected: tuple[int, ...], *, private: bool
) -> str:
    """Detail of a failure the worker reported.

    Args:
        expected: the shape to name in one
        private: whether it knows cases, and may not speak freely
    """
    if status is ReplyKind.SHAPE:
        return f"got shape {shape_words(body, expected)}, expected {expected}"
    text = printable(body.decode("utf-8", "replace")).strip()
    if not private:
        return text
    if status is ReplyKind.CONTRACT:
        return "no array of numbers, or no model with simulate"
    return text if text in KNOWN_ERRORS else "an exception of its own"


def shape_words(body: bytes, expected: tuple[int, ...]) -> str:
    """The shape a candidate returned, in numbers near the expected ones only."""
    dimensions = np.frombuffer(body[: len(body) // 8 * 8], dtype="<i8")[:SHAPE_DIMENSIONS]
    likely = {0, 1, *(n + shift for n in expected for shift in (-1, 0, 1))}
    words = [str(n) if n in likely else "?" for n in dimensions.tolist()]
    return f"({', '.join(words)})"
