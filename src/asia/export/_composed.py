"""Weighted mean of lowered models, as one program.

This is also the place for what happens to signals outside the candidate: maps of inputs and of the
past window before a model reads them, and of outputs after it, are composed here, once for all
targets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.lowering import Builder, LoweredModel, Program


def weighted_mean(parts: Sequence[tuple[float, LoweredModel]]) -> LoweredModel:
    """Combine models of the same signals; the weights add up to 1."""
    first = parts[0][1]
    if len(parts) == 1:
        return first
    initial = Builder(first.initial.inputs)
    window = list(range(len(initial.inputs)))
    starts = [x for _, model in parts for x in inlined(initial, model.initial, window)]
    states = [shape for _, model in parts for shape in model.states]
    step = Builder((*states, (first.nu,)))
    place, outputs, after = 0, list[tuple[float, int]](), list[int]()
    for weight, model in parts:
        own = list(range(place, place + len(model.states)))
        place += len(own)
        y, *found = inlined(step, model.step, [*own, len(states)])
        outputs.append((weight, y))
        after += found
    total = _sum(step, outputs)
    single = any(model.single for _, model in parts)
    return LoweredModel(
        first.n_past_u,
        first.n_past_y,
        first.nu,
        first.ny,
        single,
        initial.program(starts),
        step.program([total, *after]),
    )


def inlined(build: Builder, program: Program, inputs: Sequence[int]) -> list[int]:
    """Inline a program into another one and return the numbers of its outputs there."""
    values = [*inputs, *(build.constant(c) for c in program.constants)]
    for node in program.nodes:
        operands = [values[i] for i in node.operands]
        values.append(build.add(node.op, operands, node.attrs, node.body))
    return [values[i] for i in program.outputs]


def _sum(build: Builder, terms: Sequence[tuple[float, int]]) -> int:
    scaled = [build.add("mul", (build.constant(np.float64(w)), y)) for w, y in terms]
    total = scaled[0]
    for one in scaled[1:]:
        total = build.add("add", (total, one))
    return total
