"""Certificates: statements that random runs and exact figures do not contradict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.control.certificate import certify
from asia.control.certificate_check import check_certificate, digest, prove
from asia.errors import UserError
from asia.lowering.enclosure import enclose, interval
from asia.lowering.evaluation import evaluate
from asia.lowering.program import Builder, LoweredModel, Node, Program

LIMITS = np.array([[-1.0, 2.0]])
FACTS: dict[str, Any] = {"assumptions": []}


def model_of(build: Builder, y: int, after: int) -> LoweredModel:
    (n,) = build.shape(after)
    initial = Builder(((0, 1), (0, 1), (1,)))
    start = initial.program([initial.constant(np.zeros(n))])
    return LoweredModel(0, 0, 1, 1, False, start, build.program([y, after]))


def linear(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: float) -> LoweredModel:
    n = len(a)
    build = Builder(((n,), (1,)))
    joint = build.add("reshape", (build.add("concat", (0, 1), (0,)),), (n + 1, 1))
    rows = build.add("matmul", (build.constant(np.block([[a, b], [c, np.array([[d]])]])), joint))
    flat = build.add("reshape", (rows,), (n + 1,))
    y, after = (build.add("slice", (flat,), s) for s in ((n, n + 1, 1), (0, n, 1)))
    return model_of(build, y, after)


def tank() -> LoweredModel:
    """Two tanks: x1' = x1 + 0.1 (2 + u - sqrt(x1 + 1)), x2' = x2 + 0.1 (tanh(x1) - x2)."""
    build = Builder(((2,), (1,)))
    x1, x2 = (build.add("slice", (0,), (k, k + 1, 1)) for k in range(2))

    def number(value: float) -> int:
        return build.constant(np.array(value))

    root = build.add("sqrt", (build.add("add", (x1, number(2.0))),))
    flow = build.add("sub", (build.add("add", (1, number(2.0))), root))
    first = build.add("add", (x1, build.add("mul", (flow, number(0.1)))))
    pull = build.add("sub", (build.add("tanh", (x1,)), x2))
    second = build.add("add", (x2, build.add("mul", (pull, number(0.1)))))
    return model_of(build, x2, build.add("concat", (first, second), (0,)))


A = np.array([[0.8, 0.4], [-0.4, 0.8]])
STABLE = linear(A, np.array([[1.0], [0.5]]), np.array([[1.0, -1.0]]), 0.2)


def statement(content: dict[str, Any], kind: str) -> dict[str, Any]:
    return next(one for one in content["statements"] if one["kind"] == kind)


def random_outputs(model: LoweredModel, runs: int, samples: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    found = np.empty((runs, samples))
    for r in range(runs):
        x = np.zeros(model.states[0])
        corner = rng.random() < 0.5
        for k in range(samples):
            share = rng.integers(0, 2, 1) if corner else rng.random(1)
            y, x = evaluate(model.step, [x, LIMITS[0, 0] + 3.0 * share])
            found[r, k] = y[0]
    return found


@pytest.mark.parametrize("model", [STABLE, tank()], ids=["linear", "tanks"])
def test_random_runs_stay_in_tube_and_box(model: LoweredModel) -> None:
    content = certify(model, LIMITS, np.zeros(2), 30, FACTS)
    found = random_outputs(model, 60, 30)
    tube, box = (statement(content, kind) for kind in ("tube", "invariant box"))
    low, high = (np.array(tube[side])[:, 0] for side in ("lower", "upper"))
    assert (low <= found.min(axis=0)).all()
    assert (found.max(axis=0) <= high).all()
    assert np.min(box["lower"]) <= found.min()
    assert found.max() <= np.max(box["upper"])


def test_gains_of_a_linear_model_are_close_to_the_exact_ones() -> None:
    content = certify(STABLE, LIMITS, np.zeros(2), 5, FACTS)
    b, c = np.array([1.0, 0.5]), np.array([1.0, -1.0])
    impulse = [0.2, *(c @ np.linalg.matrix_power(A, k) @ b for k in range(400))]
    z = np.exp(1j * np.linspace(0, np.pi, 20_001))
    rise = max(abs(0.2 + c @ np.linalg.solve(s * np.eye(2) - A, b)) for s in z)
    assert statement(content, "stability")
    exact = float(np.abs(impulse).sum())
    assert exact <= statement(content, "peak gain")["bound"] <= exact * 1.0001
    assert rise <= statement(content, "H-infinity norm")["bound"] <= rise * 1.02


@pytest.mark.parametrize("size", [1.0, 1.0000001, 1.2])
def test_an_unstable_model_gets_no_certificate_of_stability(size: float) -> None:
    model = linear(A / np.sqrt(0.8) * size, np.array([[1.0], [0.5]]), np.array([[1.0, -1.0]]), 0.2)
    content = certify(model, LIMITS, np.zeros(2), 5, FACTS)
    assert [one["kind"] for one in content["statements"]] == ["tube"]
    borrowed = statement(certify(STABLE, LIMITS, np.zeros(2), 5, FACTS), "stability")
    assert not prove(model, LIMITS, borrowed)


@pytest.mark.parametrize("kind", ["peak gain", "H-infinity norm"])
def test_a_gain_that_is_too_small_is_not_proven(kind: str) -> None:
    one = statement(certify(STABLE, LIMITS, np.zeros(2), 5, FACTS), kind)
    assert prove(STABLE, LIMITS, one)
    assert not prove(STABLE, LIMITS, {**one, "bound": one["bound"] * 0.97})


def test_a_changed_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    content = certify(STABLE, LIMITS, np.zeros(2), 5, FACTS)
    path.write_text(json.dumps(content))
    assert len(check_certificate(path)) == 6
    content["u"] = [[-1.0, 3.0]]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="was changed"):
        check_certificate(path)
    # With a digest that fits, what it states is still wrong.
    content["sha256"] = digest(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="is not proven"):
        check_certificate(path)


SIGNALS: dict[str, Any] = {**FACTS, "inputs": [("pump", "V")], "outputs": [("level", "m")]}


@pytest.mark.slow
def test_limits_of_the_outputs_are_proven_or_refuted(tmp_path: Path) -> None:
    def certified(low: float, high: float) -> dict[str, Any]:
        return certify(tank(), LIMITS, np.zeros(2), 30, SIGNALS, np.array([[low, high]]))

    always = statement(certified(-8.0, 10.0), "output limits")
    assert always["always"]
    text = "within the limits, from the start, for all times: level in -8 to 10 m"
    assert always["text"] == text
    content = certified(-2.0, 3.0)
    one = statement(content, "output limits")
    assert not one["always"]
    assert one["text"] == "within the limits, from the start, for 30 samples: level in -2 to 3 m"
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(content))
    assert one["text"] in check_certificate(path)
    # A proof for some samples is none for all times, nor for narrower limits.
    assert not prove(tank(), LIMITS, {**one, "always": True})
    assert not prove(tank(), LIMITS, {**one, "upper": [1.0]})
    for high, reason in ((0.5, "do not hold: in a simulation"), (1.5, "in no simulation")):
        content = certified(-2.0, high)
        assert all(one["kind"] != "output limits" for one in content["statements"])
        assert reason in content["missed"][-1]
        assert "level is" in content["missed"][-1]


def test_gains_name_their_signals_with_units() -> None:
    content = certify(STABLE, LIMITS, np.zeros(2), 5, SIGNALS)
    gain = statement(content, "peak gain")
    assert gain["text"].startswith("peak gain of pump to level: at most ")
    assert gain["text"].endswith(" m/V")


def test_asia_certify_proves_and_checks_a_file(tmp_path: Path) -> None:
    from tests.unit.interfaces.cli.conftest import command_line

    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(certify(STABLE, LIMITS, np.zeros(2), 5, FACTS)))
    done = command_line("certify", "--check", path)
    assert done.code == 0
    assert "proven    the linear model is asymptotically stable" in done.out
    path.write_text(path.read_text().replace('"samples": ', '"samples": 1'))
    done = command_line("certify", "--check", path)
    assert done.code == 2
    assert "was changed" in done.err


def test_sqrt_of_one_and_a_square_is_enclosed_where_its_parts_would_be_negative() -> None:
    nodes = (
        Node("mul", (0, 0), (), (1,)), Node("add", (1, 2), (), (1,)), Node("sqrt", (3,), (), (1,))
    )  # fmt: skip
    program = Program(((1,),), (np.array(1.0),), nodes, (4,))
    for low, high in ((-1.0, 3.0), (-4.0, 4.0), (0.5, 60.0)):
        (found,) = enclose(program, [interval(np.array([low]), np.array([high]), 1)])
        x = np.linspace(low, high, 999)
        y = np.sqrt(1.0 + x**2)
        assert found.low <= y.min()
        assert y.max() <= found.high
        assert np.ptp([found.low, found.high]) < 2.0 * np.ptp(y)
