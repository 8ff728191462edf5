"""Binary format of a lowered model, which the parent reads strictly.

All numbers are little-endian. A program is its inputs, constants, nodes and outputs, in this order;
a shape is a count and its numbers. Nothing is skipped and nothing may follow: the reader refuses
whatever does not check before a printer sees it.
"""

import math
import re
import struct

import numpy as np

from asia.lowering.program import (
    LARGEST_RANK,
    LARGEST_SIZE,
    OPERATIONS,
    Builder,
    LoweredModel,
    Program,
    Shape,
    ShapeError,
)

MAGIC = b"ASIA-LOWERED-1\n"
REFUSED = b"ASIA-REFUSED-1\n"
REFUSAL_BYTES = 600
LARGEST_BYTES = 64 * 1024 * 1024
_MOST_NODES = 200_000
_DEEPEST = 12
_HEAD = struct.Struct("<5I")
_COUNT = struct.Struct("<I")
_NODE = struct.Struct("<BII")
_NO_TEXT = re.compile(r"[^\x20-\x7e]")


class FormatError(ValueError):
    """Bytes that are no lowered model."""


def pack(model: LoweredModel) -> bytes:
    """Pack a lowered model as bytes. Raises ShapeError if its parts do not fit together."""
    model.check()
    out = [MAGIC, _HEAD.pack(model.n_past_u, model.n_past_y, model.nu, model.ny, model.single)]
    for program in (model.initial, model.step):
        write_program(program, out)
    return b"".join(out)


def pack_refusal(reason: str) -> bytes:
    """Pack the reason why there is no lowered model."""
    return REFUSED + reason.encode("ascii", "replace")[:REFUSAL_BYTES]


def unpack(data: bytes) -> LoweredModel | str:
    """Read a lowered model, or the reason why there is none. Raises FormatError if the bytes are
    neither."""
    if data.startswith(REFUSED):
        text = data[len(REFUSED) : len(REFUSED) + REFUSAL_BYTES].decode("ascii", "replace")
        return _NO_TEXT.sub("_", text)
    if len(data) > LARGEST_BYTES or not data.startswith(MAGIC):
        raise FormatError("no lowered model")
    read = _ProgramReader(data, len(MAGIC))
    try:
        *sizes, single = read.struct(_HEAD)
        if single not in (0, 1):
            raise FormatError("no truth value")
        initial, step = read.program(0), read.program(0)
        model = LoweredModel(sizes[0], sizes[1], sizes[2], sizes[3], single == 1, initial, step)
        model.check()
    except (ShapeError, struct.error, IndexError) as error:
        raise FormatError(str(error)) from None
    if read.place != len(data):
        raise FormatError("bytes follow the model")
    return model


def unpack_for(data: bytes, sizes: tuple[int, int, int, int]) -> LoweredModel | str:
    """Read a lowered model of given n_past_u, n_past_y, nu, ny, or the reason why there is none.
    Raises FormatError if the bytes are neither, or the sizes differ."""
    found = unpack(data)
    if isinstance(found, str) or (found.n_past_u, found.n_past_y, found.nu, found.ny) == sizes:
        return found
    raise FormatError("a lowered model of other signals")


def write_program(program: Program, out: list[bytes]) -> None:
    """Append the bytes of a program."""
    out.append(_COUNT.pack(len(program.inputs)))
    out.extend(_numbers(shape) for shape in program.inputs)
    out.append(_COUNT.pack(len(program.constants)))
    for array in program.constants:
        out += [_numbers(array.shape), np.ascontiguousarray(array, "<f8").tobytes()]
    out.append(_COUNT.pack(len(program.nodes)))
    for node in program.nodes:
        code = OPERATIONS.index(node.op)
        out.append(_NODE.pack(code, len(node.operands), len(node.attrs)))
        out.append(np.array((*node.operands, *node.attrs), "<i8").tobytes())
        if node.body is not None:
            write_program(node.body, out)
    out.append(_numbers(program.outputs))


def _numbers(values: tuple[int, ...]) -> bytes:
    return _COUNT.pack(len(values)) + np.array(values, "<i8").tobytes()


class _ProgramReader:
    def __init__(self, data: bytes, place: int) -> None:
        self._data = data
        self.place = place
        self._nodes = 0

    def struct(self, layout: struct.Struct) -> tuple[int, ...]:
        found = layout.unpack_from(self._data, self.place)
        self.place += layout.size
        return found

    def program(self, depth: int) -> Program:
        if depth > _DEEPEST:
            raise FormatError("loops and calls too deep in one another")
        inputs = tuple(self._shape() for _ in range(self._count()))
        build = Builder(inputs)
        places = list(range(len(inputs)))
        for _ in range(self._count()):
            shape = self._shape()
            raw = self._bytes(8 * math.prod(shape))
            places.append(build.constant(np.frombuffer(raw, "<f8").reshape(shape)))
        for _ in range(self._count()):
            places.append(self._node(build, places, depth))
        outputs = self._integers(self._count())
        return build.program([_one_of(places, i) for i in outputs])

    def _node(self, build: Builder, places: list[int], depth: int) -> int:
        self._nodes += 1
        if self._nodes > _MOST_NODES:
            raise FormatError("too many operations")
        code, operands, attrs = self.struct(_NODE)
        if code >= len(OPERATIONS):
            raise FormatError("an unknown operation")
        read = self._integers(operands)
        op, numbers = OPERATIONS[code], self._integers(attrs)
        body = self.program(depth + 1) if op in ("loop", "call") else None
        return build.add(op, [_one_of(places, i) for i in read], numbers, body)

    def _count(self) -> int:
        return self.struct(_COUNT)[0]

    def _shape(self) -> Shape:
        rank = self._count()
        if rank > LARGEST_RANK:
            raise FormatError("an array of too many axes")
        shape = self._integers(rank)
        if any(n < 0 or n > LARGEST_SIZE for n in shape) or math.prod(shape) > LARGEST_SIZE:
            raise FormatError("an array too large")
        return shape

    def _integers(self, count: int) -> tuple[int, ...]:
        return tuple(np.frombuffer(self._bytes(8 * count), "<i8").tolist())

    def _bytes(self, length: int) -> bytes:
        if length < 0 or self.place + length > len(self._data):
            raise FormatError("bytes are missing")
        found = self._data[self.place : self.place + length]
        self.place += length
        return found


def _one_of(places: list[int], number: int) -> int:
    if not 0 <= number < len(places):
        raise FormatError("a value that is not there yet")
    return places[number]
