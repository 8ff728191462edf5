"""The framing that both ends of a worker's pipes agree on.

A request is a u64 length and a pickle, which only travels into the sandbox. A reply is a status
byte, the token of the request it answers, a u64 length and raw bytes: nothing in it is parsed.
During a fit a SCORE reply brings a model, and the next request brings its score.
"""

from __future__ import annotations

import struct
from enum import IntEnum

REQUEST_HEAD = struct.Struct("<Q")
REPLY_HEAD = struct.Struct("<B8sQ")
TOKEN_BYTES = 8

CURVE_ROWS = 2000
CURVE_ROW_BYTES = 16
TEXT_BYTES = 2048
SHAPE_DIMENSIONS = 8
DEVICE_BYTES = 100
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
