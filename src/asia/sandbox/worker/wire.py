"""The framing that both ends of a worker's pipes agree on.

A request is the u64 length of a pickle, which only travels into the sandbox, the u64 number of its
large arrays, their u64 lengths, the pickle, and these arrays, which neither end copies. A reply is
a status byte, the token of the request it answers, a u64 length and raw bytes: nothing in it is
parsed. During a fit a SCORE reply brings a model, and the next request brings its score.
"""

from __future__ import annotations

import struct
from enum import IntEnum

REQUEST_HEAD = struct.Struct("<QQ")
LENGTH = struct.Struct("<Q")
LARGE_BYTES = 65_536
"""From so many on an array travels beside the pickle."""
REPLY_HEAD = struct.Struct("<B8sQ")
TOKEN_BYTES = 8

CURVE_ROWS = 2000
CURVE_ROW_BYTES = 16
TEXT_BYTES = 2048
SHAPE_DIMENSIONS = 8
COMPILED = ("fit", "load", "simulate")
"""Requests in which JAX may compile. What it took is two float64 each: to trace, to compile."""
COMPILED_BYTES = len(COMPILED) * 16


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
