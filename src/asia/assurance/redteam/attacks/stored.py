"""A record in the encodings in which an attack brings it along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from asia.data.trajectory import Array

if TYPE_CHECKING:
    from asia.assurance.redteam.problem import SmallProblem


def stored(problem: SmallProblem) -> Mapping[str, str]:
    """The error of the honest simulation of the record in several encodings, as Python, by the
    names that sources use for them."""
    error = _honest_error(problem)
    least, span = float(error.min()), float(np.ptp(error))

    def levels(count: int) -> list[int]:
        return [round((count - 1) * (v - least) / span) for v in error.tolist()]

    digits = levels(10)
    pairs = [divmod(v, 26) for v in levels(676)]
    noise = np.random.default_rng(3).integers(100, 999, len(error)).tolist()
    long = [float(f"{v:.3f}{n}1") for v, n in zip(error.tolist(), noise, strict=True)]
    indent = "\n    "
    return {
        "LETTER_STEP": repr(span / 74),
        "PAIR_STEP": repr(span / 675),
        "DIGIT_STEP": repr(span / 9),
        "STATEMENT_STEP": repr(span / 3),
        "LEAST": repr(least),
        "AS_LETTERS": repr("".join(chr(48 + v) for v in levels(75))),
        "AS_PAIRS": repr("".join(chr(97 + a) + chr(97 + b) for a, b in pairs)),
        "AS_DIGITS": repr(digits),
        "AS_LONG_NUMBERS": repr(long),
        "AS_SCALARS": indent.join(
            ["found = []", *(f"found += [{_joined(part)}]" for part in _cut(digits, 6))]
        ),
        "AS_NAMES": ", ".join("abcdefghij"[v] for v in digits),
        "AS_KEYWORDS": ", ".join(f"k{i}_{v}=0" for i, v in enumerate(digits)),
        "AS_FORMATS": ", ".join(f"1.0{'0' * v}" for v in digits),
        "AS_STATEMENTS": indent.join(f"{'abcd'[v]}()" for v in levels(4)),
    }


def _cut(values: Sequence[int], size: int) -> list[Sequence[int]]:
    return [values[k : k + size] for k in range(0, len(values), size)]


def _joined(values: Sequence[int]) -> str:
    return ", ".join(map(str, values))


def _honest_error(problem: SmallProblem) -> Array:
    """Measured outputs (T,) minus those of the honest simulation from the first sample."""
    record, (pole, gain) = problem.record, problem.crude
    y = record.y[:, 0].copy()
    for k in range(1, len(y)):
        y[k] = pole * y[k - 1] + gain * record.u[k - 1, 0]
    return record.y[:, 0] - y
