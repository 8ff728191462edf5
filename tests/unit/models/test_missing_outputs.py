"""Gaps of one output: every family of the library fits the other output as without them."""

from __future__ import annotations

import types
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.agents.view import Facts
from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.problem.folds import cut
from asia.problem.physics import ParameterRange, Physics
from asia.problem.plant import Plant, Unknown
from asia.problem.protocol import ProtocolRule

PAST, EVERY, LENGTH = 5, 10, 400
NAMES = ("first", "second")
PHYSICS = Physics(
    states=NAMES,
    dynamics={
        "first": "-k1*sqrt(first) + k2*flow",
        "second": "k1*sqrt(first) - k3*sqrt(second)",
    },
    parameters={name: ParameterRange(0.05, 5.0) for name in ("k1", "k2", "k3")},
)
PLANT = Plant(
    source="tanks.py:simulate",
    parameters={name: Unknown(0.05, 5.0) for name in ("k1", "k2", "k3")},
    initial={name: Unknown(0.0, 5.0) for name in NAMES},
    code=b"""
def simulate(u, params, x0, dt):
    a, b, y = x0["first"], x0["second"], []
    for (flow,) in u:
        y.append((a, b))
        out = params["k1"] * max(a, 0.0) ** 0.5
        a = max(a + dt * (params["k2"] * flow - out), 0.0)
        b = max(b + dt * (out - params["k3"] * max(b, 0.0) ** 0.5), 0.0)
    return y
""",
)


def tanks(seed: int) -> Trajectory:
    """Two leaking tanks in series, slightly noisy."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 1.5, size=LENGTH // 10), 10)
    x = np.ones((LENGTH, 2))
    for k in range(LENGTH - 1):
        flows = 0.5 * u[k], 0.5 * np.sqrt(x[k, 0]), 0.6 * np.sqrt(x[k, 1])
        x[k + 1] = x[k] + 0.1 * np.array([flows[0] - flows[1], flows[1] - flows[2]])
    return Trajectory(u, x + 0.005 * rng.normal(size=x.shape), 0.1, f"tanks {seed}")


def seldom(record: Trajectory) -> Trajectory:
    """The record with its second output measured at every tenth sample."""
    y = np.array(record.y)
    y[np.arange(len(y)) % EVERY > 0, 1] = np.nan
    return Trajectory(record.u, y, record.sampling_time, record.name)


def problem_of(row: Family) -> Context:
    horizon = 40 if "windows" in row.needs else None
    outputs = tuple(Signal(name) for name in NAMES)
    return Context(
        (Signal("flow"),), outputs, 0.1, n_past_u=PAST, n_past_y=PAST, horizon=horizon, seed=1,
        physics=PHYSICS if "windows" not in row.needs else None,
        plant=PLANT if "plant" in row.needs else None,
    )  # fmt: skip


def fitted(row: Family, records: list[Trajectory]) -> Any:
    """The family at the size of tests, trained a little longer."""
    context = problem_of(row)
    facts = Facts(
        "", context.inputs, context.outputs, 0.1, tuple(records), PAST, PAST, context.physics,
        horizon=context.horizon, plant=context.plant,
    )  # fmt: skip
    recipe = row.smallest(facts)
    longer = {name: n for name, n in (("iterations", 15), ("steps", 300)) if recipe.has(name)}
    module = types.ModuleType(row.name)
    exec(recipe.changed(**longer).source(row.label), module.__dict__)
    return module.fit(records, context)


@cache
def whole_records() -> tuple[Trajectory, ...]:
    return tuple(tanks(seed) for seed in range(3))


def simulated(model: Any, context: Context) -> Array:
    """Outputs for a fresh record, from fully measured past windows."""
    rule = ProtocolRule(past_inputs=PAST, past_outputs=PAST)
    fresh = tanks(9)
    step = context.horizon or LENGTH - PAST
    starts = range(PAST, LENGTH - step + 1, step)
    cases = [cut(fresh, k, k + step, rule).case for k in starts]
    parts = [np.stack([getattr(c, name) for c in cases]) for name in ("past_u", "past_y", "u")]
    return np.asarray(model.simulate(*parts)).reshape(-1, 2)


def error(y: Array) -> float:
    """Error of the first output of the fresh record."""
    return float(np.sqrt(np.mean((y[:, 0] - tanks(9).y[PAST : PAST + len(y), 0]) ** 2)))


every_family = pytest.mark.parametrize(
    "row",
    [
        pytest.param(r, id=r.name, marks=pytest.mark.slow if r.kind == "network" else ())
        for r in all_families()
    ],
)
