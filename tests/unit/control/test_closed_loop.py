"""Certificates of closed loops: they equal the simulated loop, and hold in random runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asia.control.certificate_check import check_certificate, digest
from asia.control.closed_loop import certify_loop, closed_loop, loop_start, single_loop
from asia.control.design import (
    Loop,
    SampledController,
    SimulatedPlant,
    Transfer,
    sampled,
    simulate_loop,
)
from asia.errors import UserError
from asia.lowering.evaluation import evaluate
from asia.lowering.linear import OperatingPoint, joined, split
from asia.lowering.program import Builder, LoweredModel
from tests.unit.control.test_certificate import linear, tank

A, B, C = np.array([[0.9, 0.1], [0.0, 0.7]]), np.array([[0.0], [0.3]]), np.array([[1.0, 0.0]])
PLANT = linear(A, B, C, 0.0)
PI = Transfer(np.array([0.4, 0.05]), np.array([1.0, 0.0]))
FACTS: dict[str, Any] = {
    "assumptions": [],
    "inputs": [("r", ""), ("load", ""), ("noise", "")],
    "outputs": [("y", ""), ("u", "")],
}
INPUTS = np.array([[-0.5, 1.0], [-0.1, 0.1], [-0.02, 0.02]])


def simulated(name: str, model: LoweredModel) -> SimulatedPlant:
    def step(x: np.ndarray, u: float) -> tuple[float, np.ndarray]:
        y, *after = evaluate(model.step, [*split(model, x), np.array([u])])
        return float(y[0]), joined(after)

    return SimulatedPlant(name, [step], [np.zeros(2)], [model])


def loop_of(*plants: SimulatedPlant) -> Loop:
    return Loop("run", tuple(one.name for one in plants), [], list(plants), 1.0)


def outputs(model: LoweredModel, start: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    x, found = start, []
    for row in inputs:
        y, *after = evaluate(model.step, [*split(model, x), row])
        x = joined(after)
        found.append(y)
    return np.stack(found)


@pytest.mark.parametrize("model", [tank(), PLANT, linear(A, B, C, 0.2)])
@pytest.mark.parametrize(
    "limits", [{}, {"limits": (-0.3, 0.4), "rate": 0.15}], ids=["free", "limited"]
)
def test_the_closed_loop_is_the_simulated_one(model: LoweredModel, limits: dict[str, Any]) -> None:
    controller = sampled(PI, 1.0, **limits)
    plant = simulated("loop", model)
    rng = np.random.default_rng(0)
    r, noise = np.repeat(rng.uniform(-1, 1, 8), 10), 0.05 * rng.standard_normal(80)
    y, u = simulate_loop(controller, plant, r, noise)
    loop = closed_loop(plant.lowered[0], controller, limited=True)
    found = outputs(loop, loop_start(plant, controller), np.stack([r, 0 * r, noise], axis=1))
    assert found[:, 0] == pytest.approx(y, abs=1e-12)
    assert found[:, 1] == pytest.approx(u, abs=1e-12)


def test_a_pair_of_a_larger_model_holds_the_other_inputs() -> None:
    build = Builder(((2,), (3,)))
    drive = build.constant(np.array([[0.1, 0.2, 0.3], [0.0, 0.5, -0.4]]))
    moved = build.add("matmul", (drive, build.add("reshape", (1,), (3, 1))))
    kept = build.add("mul", (build.constant(np.array([0.9, 0.5])), 0))
    after = build.add("add", (kept, build.add("reshape", (moved,), (2,))))
    start = Builder(((0, 3), (0, 2), (3,)))
    plant = LoweredModel(0, 0, 3, 2, False, start.program([start.constant(np.zeros(2))]),
                         build.program([0, after]))  # fmt: skip
    at = OperatingPoint(np.array([0.3, -0.2]), np.array([1.0, 2.0, 3.0]), np.zeros(2), 0.0)
    one = single_loop(plant, at, 1, 0)
    one.check()
    u = np.random.default_rng(0).standard_normal(20)
    whole = outputs(plant, at.x, np.stack([u, np.full(20, 2.0), np.full(20, 3.0)], axis=1))
    assert outputs(one, at.x, u[:, None])[:, 0] == pytest.approx(whole[:, 1], abs=1e-12)


def certified(
    controller: SampledController, *plants: SimulatedPlant, y: np.ndarray | None = None
) -> dict[str, Any]:
    return certify_loop(loop_of(*plants), controller, INPUTS, 20, FACTS, y)


def kinds(content: dict[str, Any], model: str) -> set[str]:
    rows = [one for one in content["loops"] if one["model"] == model]
    return {statement["kind"] for one in rows for statement in one["statements"]}


@pytest.mark.slow
def test_random_runs_stay_within_what_is_proven() -> None:
    controller = sampled(PI, 1.0, limits=(-5.0, 5.0))
    for plant, kind in ((simulated("loop", PLANT), "limits"), (simulated("tanks", tank()), "tube")):
        content = certified(controller, plant)
        proven = next(s for s in content["loops"][-1]["statements"] if s["kind"] == kind)
        model = closed_loop(plant.lowered[0], controller, limited=True)
        rng, runs = np.random.default_rng(1), []
        for _ in range(40):
            share = np.repeat(rng.integers(0, 2, (2 if kind == "tube" else 30, 3)), 10, axis=0)
            inputs = INPUTS[:, 0] + (INPUTS[:, 1] - INPUTS[:, 0]) * share
            runs.append(outputs(model, loop_start(plant, controller), inputs))
        found = np.stack(runs)
        lower, upper = np.array(proven["lower"]), np.array(proven["upper"])
        assert (lower <= found.min(axis=0)).all()
        assert (found.max(axis=0) <= upper).all()
        if kind == "limits":
            assert (upper - lower)[0] < 1.3 * np.ptp(found[..., 0])


@pytest.mark.slow
def test_a_loop_that_is_unstable_gets_nothing_for_all_times() -> None:
    controller = sampled(replace(PI, num=40.0 * PI.num), 1.0)
    content = certified(controller, simulated("loop", PLANT))
    assert kinds(content, "loop") <= {"tube"}
    stable = certified(sampled(PI, 1.0), simulated("loop", PLANT))
    assert {"stability", "limits", "peak gain"} <= kinds(stable, "loop")


@pytest.mark.long
def test_a_set_of_models_is_checked_one_by_one(tmp_path: Path) -> None:
    plants = simulated("loop", PLANT), simulated("fold 1", linear(A, 1.1 * B, C, 0.0))
    y = np.array([[-2.0, 3.0], [-np.inf, np.inf]])
    content = certified(sampled(PI, 1.0, limits=(-5.0, 5.0)), *plants, y=y)
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(content))
    sentences = check_certificate(path)
    assert sentences == [one["text"] for one in content["statements"]]
    assert "all 2 models: the loop is asymptotically stable" in sentences
    assert "all 2 models: within the limits, from the start, for all times: y in -2 to 3, " in (
        " ".join(sentences)
    )
    # The worst of the models counts.
    gains = [
        one["bound"]
        for loop in content["loops"]
        for one in loop["statements"]
        if one["kind"] == "peak gain" and one["output"] == 0 and one["input"] == 0
    ]
    assert f"peak gain of r to y: at most {max(gains):.6g}" in " ".join(sentences)
    content["loops"][1]["u"][0][1] = 5.0
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="was changed"):
        check_certificate(path)
    content["sha256"] = digest(content)
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="is not proven"):
        check_certificate(path)


@pytest.mark.slow
def test_limits_of_the_input_that_act_are_part_of_the_loop() -> None:
    controller = sampled(PI, 1.0, limits=(-0.1, 0.2))
    content = certified(controller, simulated("loop", PLANT))
    free, held = content["loops"]
    assert free["subject"] == "the loop without limits of its input"
    assert {one["kind"] for one in free["statements"]} <= {
        "stability", "peak gain", "H-infinity norm",
    }  # fmt: skip
    tube = next(one for one in held["statements"] if one["kind"] == "tube")
    assert np.max(tube["upper"], axis=0)[1] < 0.2 + 1e-6
