"""Sources of cheating candidates: an honest one with something in it, or a list of attempts."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.redteam.problem import SmallProblem


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
    for name, text in facts.items():
        source = source.replace(name, text)
    return source


HONEST = candidate()
