"""Gaps of one output: every family of the library fits the other output as without them."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.agents.view import Facts
from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models._linear.fit import solve_linear_part
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import output_groups, scaled
from asia.problem.folds import cut
from asia.problem.physics import ParameterRange, Physics
from asia.problem.plant import Plant, Unknown
from asia.problem.protocol import ProtocolRule

PAST, EVERY, LENGTH = 5, 10, 400
QUICK = {"arx", "greybox"}
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


def tanks(x: Array, u: float) -> Array:
    """Rates of the levels of two leaking tanks in series."""
    first, second = 0.5 * np.sqrt(x[0]), 0.6 * np.sqrt(x[1])
    return np.array([0.5 * u - first, first - second])


def cart(x: Array, u: float) -> Array:
    """Rates of the speed and the place of a cart with drag."""
    return np.array([u - 1.0 - 0.5 * x[0] * abs(x[0]), x[0]])


def drawn(seed: int, system: Callable[[Array, float], Array] = tanks) -> Trajectory:
    """A record, slightly noisy."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 1.5, size=LENGTH // 10), 10)
    x = np.ones((LENGTH, 2))
    for k in range(LENGTH - 1):
        x[k + 1] = x[k] + 0.1 * system(x[k], u[k])
    return Trajectory(u, x + 0.005 * rng.normal(size=x.shape), 0.1, f"record {seed}")


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
        physics=None if horizon else PHYSICS,
        plant=PLANT if "plant" in row.needs else None,
    )  # fmt: skip


def fitted(row: Family, records: list[Trajectory]) -> Any:
    """The family at the size of tests, trained a little longer."""
    context = problem_of(row)
    facts = Facts(**context.known(), records=tuple(records))
    recipe = row.smallest(facts)
    longer = {name: n for name, n in (("iterations", 15), ("steps", 300)) if recipe.has(name)}
    module = types.ModuleType(row.name)
    exec(recipe.changed(**longer).source(row.label), module.__dict__)
    return module.fit(records, context)


def simulated(model: Any, context: Context, fresh: Trajectory) -> Array:
    """Outputs for a fresh record, from fully measured past windows."""
    rule = ProtocolRule(past_inputs=PAST, past_outputs=PAST)
    step = context.horizon or LENGTH - PAST
    starts = range(PAST, LENGTH - step + 1, step)
    cases = [cut(fresh, k, k + step, rule) for k in starts]
    parts = [np.stack([getattr(c, name) for c in cases]) for name in ("past_u", "past_y", "u")]
    return np.asarray(model.simulate(*parts)).reshape(-1, 2)


every_family = pytest.mark.parametrize(
    "row",
    [
        pytest.param(
            r,
            id=r.name,
            marks=() if r.name in QUICK else pytest.mark.long if r.seeds else pytest.mark.slow,
        )
        for r in all_families()
        if "single" not in r.needs
    ],
)


@every_family
def test_gaps_of_one_output_cost_the_other_nothing(row: Family) -> None:
    """The second output is measured at every tenth sample. The error of the first one stays, and a
    value given where an output is missing changes no simulated sample."""
    # Of a kinematic network one output is the integral of the other.
    *full, fresh = (
        drawn(seed, cart if row.name == "kinematic" else tanks) for seed in (0, 1, 2, 9)
    )
    few = [seldom(r) for r in full]
    hidden = [replace(r, y=np.where(r.measured, r.y, 50.0)) for r in few]
    found, whole, other = (
        simulated(fitted(row, records), problem_of(row), fresh) for records in (few, full, hidden)
    )
    few_error, whole_error = (
        np.sqrt(np.mean((y - fresh.y[PAST : PAST + len(y)])[:, 0] ** 2)) for y in (found, whole)
    )
    assert few_error <= 1.3 * whole_error
    assert other.tobytes() == found.tobytes()


@given(st.integers(0, 1000))
def test_gaps_in_one_output_leave_the_regression_rows_of_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weight = np.ones((50, 3))
    weight[:, 1] = rng.random(50) < 0.2
    rows = {i: np.arange(50)[at] for at, outputs in output_groups(weight) for i in outputs.tolist()}
    assert all(np.array_equal(rows[i], np.flatnonzero(weight[:, i])) for i in range(3))


def test_an_unmeasured_value_weighs_nothing_in_the_simulation_error() -> None:
    """The same where no straight line hides the value: residuals are multiplied by the weight."""
    record = seldom(drawn(0))
    (one,) = scaled([record], Scaling.of([record]))
    other = replace(one, y=np.where(one.weight > 0, one.y, 1e3))
    a, c = np.diag([0.9, 0.8]), np.eye(2)
    solved = [solve_linear_part([r], a, c) for r in (one, other)]
    assert solved[0].system.b.tobytes() == solved[1].system.b.tobytes()
    assert solved[0].error == solved[1].error
