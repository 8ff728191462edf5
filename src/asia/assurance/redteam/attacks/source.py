"""Sources of cheating candidates: an honest one with something in it, or a list of attempts."""

from __future__ import annotations

import textwrap
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


STEPS = "STEPS "
HONEST_FUNCTION = """\
def honest(past_u, past_y, u):
    x, v, y = past_y[:, -1], past_u[:, -1, :1], np.empty(u.shape[:2] + past_y.shape[2:])
    for k in range(u.shape[1]):
        x = POLE * x + GAIN * v
        v = u[:, k, :1]
        y[:, k] = x
    return y
"""
"""Simulation of an honest first-order model."""
_TEXT = """
import ctypes, errno, gc, json, os, pickle, signal, socket, struct, subprocess, sys, time
import numpy as np

globals().update(GIVEN)
POLE, GAIN = CRUDE
libc = ctypes.CDLL(None, use_errno=True)
libc.prctl(15, MARK.encode(), 0, 0, 0)


HONEST_FUNCTION


def call(result):
    if result < 0:
        raise OSError(ctypes.get_errno(), "refused")


def attempt(code):
    try:
        exec(code, globals())
    except OSError as error:
        return errno.errorcode.get(error.errno, "error")
    except BaseException as error:
        return type(error).__name__
    return "done"


class Model:
    def simulate(self, past_u, past_y, u):
        BEFORE
        return AFTER


TOP


def fit(trajectories, context):
    FIT
    return Model()
"""


def candidate(
    fit: str = "pass", before: str = "pass", after: str = "honest(past_u, past_y, u)", top: str = ""
) -> str:
    """Make the honest candidate with additional code.

    The name GIVEN in the code is replaced by the data of the attack.

    Args:
        fit: code in `fit`
        before: code in `simulate` before the result
        after: result of `simulate`
        top: code at the top level
    """
    text = _TEXT.replace("HONEST_FUNCTION\n", HONEST_FUNCTION)
    text = text.replace("BEFORE", textwrap.indent(before, " " * 8).strip())
    text = text.replace("AFTER", after).replace("TOP", top)
    return text.replace("    FIT", textwrap.indent(fit.strip("\n"), " " * 4))


def steps(attempts: Mapping[str, str], top: str = "") -> str:
    """Make a candidate that runs each of these codes in its fit and prints the result of each:
    `done`, or the name of the error."""
    fit = f"print({STEPS!r} + json.dumps({{n: attempt(c) for n, c in {dict(attempts)!r}.items()}}))"
    return candidate(fit=fit, top=top)


def fill_in(source: str, given: str, problem: SmallProblem) -> str:
    """Fill the data of an attack into a source, as Python.

    It also receives pole and gain of an honest model, and for a table the measured outputs.
    """
    y = problem.record.y[:, 0]
    facts = {
        "GIVEN": given,
        "CRUDE": repr(problem.crude),
        "ALL_DIGITS": repr(y.tolist()),
        "THREE_DIGITS": repr([round(1000 * v) for v in y.tolist()]),
        "ALL_INPUTS": repr([round(100 * v) for v in problem.record.u[:, 0].tolist()]),
    }
    facts |= stored(problem)
    for name, text in facts.items():
        source = source.replace(name, text)
    return source


HONEST = candidate()
