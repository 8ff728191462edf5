"""The framing that both ends of a worker's pipes agree on.

A request is a u64 length and a pickle, which only travels into the sandbox. A reply is a status
byte, the token of the request it answers, a u64 length and raw bytes: nothing in it is parsed.
During a fit a SCORE reply brings a model, and the next request brings its score.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from enum import IntEnum

REQUEST_HEAD = struct.Struct("<Q")
REPLY_HEAD = struct.Struct("<B8sQ")
TOKEN_BYTES = 8

CURVE_ROWS = 2000
CURVE_ROW_BYTES = 16
TEXT_BYTES = 2048
SHAPE_DIMENSIONS = 8
COMPILED = ("fit", "load", "simulate")
"""Requests in which JAX may compile. What it took is two float64 each: to trace, to compile."""
COMPILED_BYTES = len(COMPILED) * 16
PARAMETERS = 64
"""The most named parameters of a fitted model that are kept."""
_PARAMETER = struct.Struct("<48sd")
PARAMETERS_BYTES = PARAMETERS * _PARAMETER.size
_NO_NAME = re.compile(r"[^A-Za-z0-9 _.,/\[\]-]")


class ReplyKind(IntEnum):
    """First byte of a reply. All but OK, STARTED and SCORE end the worker."""

    OK = 0
    STARTED = 1
    SYNTAX = 2
    CONTRACT = 3
    CRASH = 4
    EXITED = 5
    MEMORY = 6
    SHAPE = 7
    SCORE = 8


def pack_parameters(offered: object) -> bytes:
    """Rows of one length, each a name and a float64; what is not finite is left out. Raises where
    `offered` is no mapping of names to numbers."""
    if not isinstance(offered, Mapping):
        raise TypeError("parameters: expected a mapping of names to numbers")
    rows = [(str(name).encode("ascii", "replace")[:48], float(v)) for name, v in offered.items()]
    finite = [row for row in rows if math.isfinite(row[1])]
    return b"".join(_PARAMETER.pack(*row) for row in finite[:PARAMETERS])


def unpack_parameters(body: bytes) -> tuple[tuple[str, float], ...]:
    """The names, of letters, digits and a few marks, each once, with their numbers. Raises
    ValueError where `body` has another size than rows have, or a number is not finite."""
    if len(body) % _PARAMETER.size or len(body) > PARAMETERS_BYTES:
        raise ValueError(f"{len(body)} bytes of parameters")
    found: dict[str, float] = {}
    for raw, value in _PARAMETER.iter_unpack(body):
        if not math.isfinite(value):
            raise ValueError("a parameter that is not finite")
        name = _NO_NAME.sub("_", raw.rstrip(b"\0").decode("ascii", "replace"))
        found.setdefault(name or "_", value)
    return tuple(found.items())
