"""Values, constants and memory of printed C."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from asia.data import Array
from asia.lowering import Shape

Element = Callable[[str], str]
"""C expression of the number at a place, which is itself an expression."""


@dataclass
class Value:
    """Value of the program: a place in memory, or an expression that computes it."""

    at: Element
    shape: Shape
    plain: bool = True
    """`at` is a place, not a computation."""
    places: frozenset[int] = frozenset()
    """Regions of `w` that the value reads."""


@dataclass
class Constants:
    """`static const` arrays, equal ones once."""

    lines: list[str] = field(default_factory=list[str])
    _names: dict[bytes, str] = field(default_factory=dict[bytes, str])

    def reals(self, array: Array) -> str:
        """Name of an array of numbers."""
        numbers = [number(float(v)) for v in array.reshape(-1)]
        return self._named(array.tobytes(), "k", "asia_real", numbers)

    def places(self, array: NDArray[np.int64]) -> str:
        """Name of an array of whole numbers."""
        literals = [str(v) for v in array.tolist()]
        return self._named(b"p" + array.tobytes(), "p", "long", literals)

    def used_in(self, text: str) -> list[str]:
        """Definitions of the constants that a text names."""
        names = set(re.findall(r"\b[kp]\d+\b", text))
        return [
            x for x, name in zip(self.lines, self._names.values(), strict=True) if name in names
        ]

    def _named(self, key: bytes, prefix: str, kind: str, literals: Sequence[str]) -> str:
        if key not in self._names:
            name = f"{prefix}{len(self._names)}"
            self._names[key] = name
            rows = [", ".join(literals[i : i + 4]) for i in range(0, len(literals), 4)]
            text = ",\n    ".join(rows)
            self.lines.append(f"static const {kind} {name}[{len(literals)}] = {{\n    {text}\n}};")
        return self._names[key]


def number(value: float) -> str:
    """Literal that C reads back bit by bit."""
    if math.isinf(value):
        return "(asia_real)HUGE_VAL" if value > 0 else "(-(asia_real)HUGE_VAL)"
    if value == int(value) and abs(value) < 1e6:
        return f"R({value:.1f})"
    return f"R({value.hex()})"


class Memory:
    """Regions of the array `w`."""

    def __init__(self) -> None:
        self.size = 0
        self._free: list[tuple[int, int]] = []
        self._taken: dict[int, int] = {}

    def take(self, count: int) -> int:
        """Reserve a region of so many numbers and return its start."""
        for place, (start, size) in enumerate(self._free):
            if size >= count:
                self._free[place : place + 1] = [(start + count, size - count)] * (size > count)
                self._taken[start] = count
                return start
        start, self.size = self.size, self.size + count
        self._taken[start] = count
        return start

    def give(self, start: int) -> None:
        """Free a region."""
        self._free.append((start, self._taken.pop(start)))
        self._free.sort()
        joined: list[tuple[int, int]] = []
        for begin, size in self._free:
            if joined and sum(joined[-1]) == begin:
                joined[-1] = (joined[-1][0], joined[-1][1] + size)
            else:
                joined.append((begin, size))
        self._free = joined
