"""The [loop] table: reference, controller, and the reference of each record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from asia.agents.library.registry import family
from asia.data.trajectory import data_digest
from asia.errors import UserError
from asia.problem.check import check_problem
from asia.problem.feedback import Controller
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.search.agent_views import problem_facts

TOML = """
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
[data]
train = ["train.csv"]
test = ["test.csv"]
[loop]
reference = "r"
"""
CONTROLLER = "controller = { numerator = [2.0, -1.0], denominator = [1.0, -1.0] }\n"

Write = Callable[..., Path]


def record_with_reference(samples: int = 400) -> str:
    rng = np.random.default_rng(0)
    r = np.repeat(rng.choice([-1.0, 1.0], samples), 10)[:samples]
    x, rows = 0.0, list[str]()
    for k in range(samples):
        y = x + 0.1 * rng.standard_normal()
        u = 2.0 * (r[k] - y)
        rows.append(f"{k / 10:.1f},{float(u)!r},{float(y)!r},{float(r[k])!r}")
        x = 0.8 * x + 0.2 * u
    return "\n".join(["t,u,y,r", *rows, ""])


def test_records_carry_their_reference_through_cuts_digest_and_lock(
    write_problem: Write, tmp_path: Path
) -> None:
    folder = write_problem(TOML + CONTROLLER, train=record_with_reference())
    problem = load_problem(folder)
    (measured,) = problem.train
    assert measured.u.shape == (400, 1)
    assert measured.reference is not None
    assert set(measured.reference[:, 0].tolist()) == {-1.0, 1.0}
    for part in (measured[30:50], measured.alone(30, 50)):
        np.testing.assert_array_equal(part.reference, measured.reference[30:50])
    moved = replace(measured, reference=measured.reference + 1.0)
    assert data_digest([moved]) != data_digest([measured])
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    again = load_lock(path)
    assert again.loop == problem.loop
    assert data_digest(again.train) == data_digest(problem.train)


def test_check_says_which_method_applies_and_why(write_problem: Write) -> None:
    folder = write_problem(TOML, train=record_with_reference())
    lines = "\n".join(check_problem(load_problem(folder), Seal(None)).lines())
    assert "reference r enters at the controller; controller unknown" in lines
    assert "take linear with loop='direct'" in lines
    (folder / "problem.toml").write_text(TOML + CONTROLLER)
    problem = load_problem(folder)
    lines = "\n".join(check_problem(problem, Seal(None)).lines())
    assert "take linear with loop='controller'" in lines
    row = family("linear")
    assert row is not None
    assert row.trial(problem_facts(problem)).get("loop") == "controller"
    (folder / "problem.toml").write_text(TOML + 'inputs = "explained"\n')
    problem = load_problem(folder)
    lines = "\n".join(check_problem(problem, Seal(None)).lines())
    assert "every family is fitted and scored" in lines
    assert row.trial(problem_facts(problem)).get("loop") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('reference = "u"', "named 2 times"),
        ("reference = []", "names no signal"),
        ('reference = "r"\nenters = "sensor"', "enters"),
        ('reference = ["r", "t"]', "expected 1: one for each output"),
        ('reference = "r"\ncontroller = { numerator = [1.0] }', "is no controller"),
        ('reference = "r"\ncontroller = "os:getcwd"', "controller is"),
        ('reference = "r"\ncontroller = { d = [[1.0, 1.0]] }', "2 errors and 1 outputs"),
        ('reference = "r"\n[preprocess]\ndecimate = 2', "leave one of them out"),
    ],
)
def test_a_wrong_loop_is_a_sentence(write_problem: Write, text: str, words: str) -> None:
    toml = TOML.replace('reference = "r"', text)
    folder = write_problem(toml, train=record_with_reference())
    with pytest.raises(UserError, match=words):
        load_problem(folder)


def test_controllers_of_coefficients_and_of_matrices_are_the_same(write_problem: Write) -> None:
    """The lines that docs/problem.md prints from a system of SciPy."""
    system = signal.dlti([2.0, -1.0], [1.0, -1.0], dt=0.1)
    a, b, c, d = (m.tolist() for m in (lambda s: (s.A, s.B, s.C, s.D))(system.to_ss()))
    loops = list[Controller]()
    folder = write_problem(TOML, train=record_with_reference())
    for line in (
        "controller = { "
        f"numerator = {system.num.tolist()}, denominator = {system.den.tolist()} }}",
        f"controller = {{ a = {a}, b = {b}, c = {c}, d = {d} }}",
    ):
        (folder / "problem.toml").write_text(TOML + line)
        loop = load_problem(folder).loop
        assert loop is not None
        assert loop.controller is not None
        loops.append(loop.controller)
    given, found = loops
    e = np.random.default_rng(0).normal(size=50)
    truth = signal.lfilter([2.0, -1.0], [1.0, -1.0], e)
    for controller, late in ((given, 0), (found, 0), (given.delayed(2), 2)):
        a, b, c, d = controller.matrices
        x, u = np.zeros(len(a)), np.empty(50)
        for k in range(50):
            u[k] = (c @ x + d[:, 0] * e[k])[0]
            x = a @ x + b[:, 0] * e[k]
        np.testing.assert_allclose(u[late:], truth[: 50 - late], rtol=1e-9, atol=1e-9)
