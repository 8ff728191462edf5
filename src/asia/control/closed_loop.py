"""Closed loop of a lowered model and a sampled controller, as one lowered model, and its
certificates.

The loop has the inputs set point, load at the input of the plant, and measurement noise, and the
outputs y and u. Without limits a loop of a linear plant is affine. Limits that are proven to act
never do not change it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from asia.control.certificate import certify
from asia.control.certificate_check import FORMAT, common_sentences, digest
from asia.control.design import Loop, SampledController, SimulatedPlant
from asia.data.trajectory import Array
from asia.lowering.linear import OperatingPoint, split
from asia.lowering.program import Builder, LoweredModel, inlined

INPUTS = ("r", "load", "noise")
"""Inputs of a closed loop: set point, load at the input of the plant, measurement noise."""
_LINEAR = frozenset(("stability", "peak gain", "H-infinity norm"))


def closed_loop(
    plant: LoweredModel, controller: SampledController, *, limited: bool
) -> LoweredModel:
    """Connect a plant with one input and one output to a controller.

    Args:
        plant: lowered model
        controller: PID or LQR
        limited: whether u stays within the limits and the rate of the controller

    Returns:
        model with inputs r, load, noise; states of the plant, of the controller, last u;
        outputs y, u, and the change of u in a sample if the controller has a rate
    """
    n, m = len(controller.c), len(plant.states)
    own = ((n,),) if n else ()
    build = Builder((*plant.states, *own, (1,), (3,)))
    memory, inputs = m + len(own), m + len(own) + 1

    def part(value: int, k: int) -> int:
        return build.add("slice", (value,), (k, k + 1, 1))

    def number(value: float) -> int:
        return build.constant(np.array([value]))

    def times(matrix: Array, values: Sequence[int]) -> int:
        joint = build.add("concat", values, (0,))
        column = build.add("reshape", (joint,), (matrix.shape[1], 1))
        product = build.add("matmul", (build.constant(matrix), column))
        return build.add("reshape", (product,), (len(matrix),))

    last, states = memory, range(m)
    (seen,) = _inlined(build, plant, [*states, last], 1)
    dr = build.add("sub", (part(inputs, 0), number(controller.y0)))
    measured = build.add("add", (seen, part(inputs, 2)))
    dy = build.add("sub", (measured, number(controller.y0)))
    known = [m, dr, dy] if n else [dr, dy]
    away = times(np.concatenate([controller.c, controller.d])[None], known)
    u = build.add("add", (away, number(controller.u0)))
    if limited:
        most = controller.rate * controller.sampling_time
        if math.isfinite(controller.low):
            u = build.add("max", (u, number(controller.low)))
        if math.isfinite(controller.high):
            u = build.add("min", (u, number(controller.high)))
        if math.isfinite(most):
            u = build.add("max", (u, build.add("sub", (last, number(most)))))
            u = build.add("min", (u, build.add("add", (last, number(most)))))
    y, *after = _inlined(build, plant, [*states, build.add("add", (u, part(inputs, 1)))], None)
    if n:
        du = build.add("sub", (u, number(controller.u0)))
        after.append(times(np.hstack([controller.a, controller.b]), [*known, du]))
    after.append(u)
    shown = [y, u]
    if math.isfinite(controller.rate):
        shown.append(build.add("sub", (u, last)))
    start = Builder(((0, 3), (0, len(shown)), (3,)))
    zeros = [start.constant(np.zeros(shape)) for shape in build.inputs[:-1]]
    step = build.program([build.add("concat", shown, (0,)), *after])
    return LoweredModel(0, 0, 3, len(shown), plant.single, start.program(zeros), step)


def single_loop(plant: LoweredModel, at: OperatingPoint, output: int, given: int) -> LoweredModel:
    """Model of one output and one input, which begins at an operating point and holds the other
    inputs there."""
    if plant.nu == plant.ny == 1:
        return plant
    build = Builder((*plant.states, (1,)))
    m = len(plant.states)
    parts = [build.constant(at.u[:given]), m, build.constant(at.u[given + 1 :])]
    u = build.add("concat", parts, (0,))
    y, *after = _inlined(build, plant, [*range(m), u], None)
    shown = build.add("slice", (y,), (output, output + 1, 1))
    start = Builder(((0, 1), (0, 1), (1,)))
    states = [start.constant(one) for one in split(plant, at.x)]
    step = build.program([shown, *after])
    return LoweredModel(0, 0, 1, 1, plant.single, start.program(states), step)


def _inlined(
    build: Builder, plant: LoweredModel, inputs: Sequence[int], most: int | None
) -> list[int]:
    """Numbers of output and states of a plant, or of its first `most` results."""
    outputs = plant.step.outputs[:most]
    return inlined(build, plant.step.with_outputs(outputs), inputs)


def loop_start(plant: SimulatedPlant, controller: SampledController) -> Array:
    """State of a closed loop at its operating point."""
    held = np.zeros(len(controller.c))
    return np.concatenate([plant.starts[0], held, [controller.u0]])


def certify_loop(
    loop: Loop, controller: SampledController, inputs: Array, horizon: int, facts: dict[str, Any],
    y: Array | None = None, log: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:  # fmt: skip
    """Find and prove statements on the closed loop with each model of a set.

    Args:
        loop: plants with their lowered models
        controller: PID or LQR
        inputs: least and largest set point, load and noise, (3, 2)
        horizon: samples of the tube
        facts: entries of the certificate: `assumptions`, `inputs`, `outputs` (y and u)
        y: limits of y and u (2, 2) to prove, infinite for none
        log: receives a line before the proofs of each model

    Returns:
        the certificate, with `loops`: one certificate a model. A loop whose input is not proven to
        stay within its limits has two: one with limits, and one without them for what is linear
    """
    most = controller.rate * controller.sampling_time
    wanted = np.tile([-np.inf, np.inf], (2, 1)) if y is None else y
    outputs, own = [*facts["outputs"]], np.array([controller.low, controller.high])
    limits = np.column_stack([
        np.maximum(wanted[:, 0], [-np.inf, own[0]]), np.minimum(wanted[:, 1], [np.inf, own[1]]),
    ])  # fmt: skip
    if math.isfinite(most):
        outputs.append(("change of u", facts["outputs"][1][1]))
        limits = np.vstack([limits, [[-most, most]]])
        wanted = np.vstack([wanted, [[-np.inf, np.inf]]])
    is_limited = bool(np.isfinite([*own, most]).any())
    loops: list[dict[str, Any]] = []
    for plant in loop.simulated:
        if len(plant.lowered) != 1:
            continue
        log(f"proving   loop with {plant.name}")

        def found(plant: SimulatedPlant, subject: str, y: Array, *, limited: bool) -> Any:
            return certify(
                closed_loop(plant.lowered[0], controller, limited=limited), inputs,
                loop_start(plant, controller), horizon,
                {"model": plant.name, "subject": subject, "inputs": facts["inputs"],
                 "outputs": outputs, "assumptions": []},
                y if np.isfinite(y).any() else None,
            )  # fmt: skip

        free = found(plant, "the loop", limits, limited=False)
        kept = [one for one in free["statements"] if one["kind"] == "output limits"]
        if is_limited and not any(one["always"] for one in kept):
            held = found(plant, "the loop", wanted, limited=True)
            linear = [one for one in free["statements"] if one["kind"] in _LINEAR]
            free = {
                **free,
                "subject": "the loop without limits of its input",
                "statements": linear,
                "missed": [m for m in free["missed"] if _is_linear(m)],
            }
            held["missed"] = [m for m in held["missed"] if not _is_linear(m)]
            loops += [{**one, "sha256": digest(one)} for one in (free, held)]
        else:
            loops.append(free)
    texts = [{"text": one} for one in common_sentences(loops)]
    missed = [f"{one['model']}: {line}" for one in loops for line in one["missed"]]
    content = {"format": FORMAT, **facts, "statements": texts, "missed": missed, "loops": loops}
    return {**content, "sha256": digest(content)}


def _is_linear(missed: str) -> bool:
    """Whether a sentence is about a statement on linear models alone."""
    return any(kind in missed for kind in _LINEAR)
