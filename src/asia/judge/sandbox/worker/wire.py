"""Framing of messages on a worker's pipes.

A request is the u64 length of a pickle, which only travels into the sandbox, the u64 number of its
large arrays, their u64 lengths, the pickle, and these arrays, which neither end copies. A reply is
a status byte, the token of the request it answers, a u64 length and raw bytes: nothing in it is
parsed. During a fit a SCORE reply brings a model, and the next request brings its score; a PROGRAM
reply brings the key of a compiled program, and the next request brings the program, if it is known;
a LOSS reply brings the last row of the training curve, and no request answers it.

A `stream` request is followed by frames of one size: the token of the reply, 1, and one input
sample as float64 (B, nu). Each is answered before the next is sent. A frame with 0 ends the stream
and has no reply.
"""

from __future__ import annotations

import os
import pickle
import re
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
LOSS_SECONDS = 0.5
"""Least time between two LOSS replies."""
TEXT_BYTES = 2048
SHAPE_DIMENSIONS = 8
COMPILED = ("fit", "load", "simulate")
"""Requests in which JAX may compile. Each reports two float64: seconds to trace and to compile."""
COMPILED_BYTES = len(COMPILED) * 16
PROGRAM_KEY_BYTES = 200
PROGRAM_KEY = re.compile(rb"[\w.-]{1,%d}" % PROGRAM_KEY_BYTES)
"""Keys of compiled programs."""
PROGRAM_BYTES = 8 * 1024 * 1024
"""Greatest size of a compiled program, and of all that one worker hands over."""


class ReplyKind(IntEnum):
    """First byte of a reply. All but OK, STARTED, SCORE, PROGRAM and LOSS end the worker."""

    OK = 0
    STARTED = 1
    SYNTAX = 2
    CONTRACT = 3
    CRASH = 4
    EXITED = 5
    MEMORY = 6
    SHAPE = 7
    SCORE = 8
    PROGRAM = 9
    LOSS = 10


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


def packed_programs(programs: dict[str, bytes]) -> bytes:
    """Compiled programs with their keys, as many as fit into `PROGRAM_BYTES`."""
    parts: list[bytes] = []
    room = PROGRAM_BYTES
    for key, program in programs.items():
        name = key.encode()
        size = 2 * LENGTH.size + len(name) + len(program)
        if size <= room and PROGRAM_KEY.fullmatch(name):
            room -= size
            parts += [LENGTH.pack(len(name)), LENGTH.pack(len(program)), name, program]
    return b"".join(parts)


def unpacked_programs(data: bytes) -> dict[str, bytes]:
    """Programs that `packed_programs` packed. Raises ValueError for anything else."""
    programs: dict[str, bytes] = {}
    at = 0
    while at < len(data):
        head = data[at : at + 2 * LENGTH.size]
        if len(head) < 2 * LENGTH.size:
            raise ValueError("a program without its length")
        name, size = struct.unpack("<QQ", head)
        begin = at + len(head) + name
        key, at = data[at + len(head) : begin], begin + size
        if at > len(data) or not PROGRAM_KEY.fullmatch(key):
            raise ValueError("a program without its key or its end")
        programs[key.decode()] = data[begin:at]
    return programs
