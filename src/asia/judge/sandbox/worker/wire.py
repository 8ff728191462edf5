"""Framing of messages on a worker's pipes.

A request is the u64 length of a pickle, which only travels into the sandbox, the u64 number of its
large arrays, their u64 lengths, the pickle, and these arrays, which neither end copies. A reply is
a status byte, the token of the request it answers, a u64 length and raw bytes: nothing in it is
parsed. During a fit a SCORE reply brings a model, and the next request brings its score.

A `stream` request is followed by frames of one size: the token of the reply, 1, and one input
sample as float64 (B, nu). Each is answered before the next is sent. A frame with 0 ends the stream
and has no reply.
"""

from __future__ import annotations

import os
import pickle
import struct
from enum import IntEnum
from typing import Any

REQUEST_HEAD = struct.Struct("<QQ")
LENGTH = struct.Struct("<Q")
LARGE_BYTES = 65_536
"""Size from which an array travels outside the pickle."""
REPLY_HEAD = struct.Struct("<B8sQ")
FRAME_HEAD = struct.Struct("<8sQ")
TOKEN_BYTES = 8

CURVE_ROWS = 2000
CURVE_ROW_BYTES = 16
TEXT_BYTES = 2048
SHAPE_DIMENSIONS = 8
COMPILED = ("fit", "load", "simulate")
"""Requests in which JAX may compile. Each reports two float64: seconds to trace and to compile."""
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


def read_request(requests: int) -> tuple[bytes, str, Any]:
    """Token, name and arguments of the next one, in the worker, which ends with its pipe."""
    import numpy as np

    from asia._heap import LARGE_RECORDS, give_back_large_arrays

    length, count = REQUEST_HEAD.unpack(_read(requests, REQUEST_HEAD.size))
    lengths = [LENGTH.unpack(_read(requests, LENGTH.size))[0] for _ in range(count)]
    body = _read(requests, length)
    if sum(lengths) > LARGE_RECORDS:
        give_back_large_arrays()
    arrays = [np.empty(size, np.uint8) for size in lengths]
    for array in arrays:
        read_into(requests, array.data)
    return pickle.loads(body, buffers=arrays)


def _read(requests: int, length: int) -> bytearray:
    data = bytearray(length)
    read_into(requests, memoryview(data))
    return data


def read_into(requests: int, data: memoryview) -> None:
    """Fill `data` from the parent, in the worker, which ends with its pipe."""
    done = 0
    while done < len(data):
        count = os.readv(requests, [data[done : done + (1 << 20)]])
        if not count:
            os._exit(0)
        done += count
