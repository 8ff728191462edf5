"""Every model family: fit, bytes, fresh worker, bitwise the same simulation; a second fit too."""

import pkgutil
import types
from dataclasses import replace

import numpy as np
import pytest

import asia.models
from asia.agents import Facts
from asia.agents.library.recipe import Settings
from asia.agents.library.table import FAMILIES, Family
from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.problem import ParameterRange, Physics
from asia.redteam._honest import SMALL_CONFIG, SMALL_METHOD
from asia.testing import check_candidate


@pytest.fixture(scope="module")
def record() -> Trajectory:
    """A leaking tank with a pump, slightly noisy."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(0.5, 1.5, size=20), 10)
    x = np.empty(len(u))
    x[0] = 1.0
    for k in range(len(u) - 1):
        x[k + 1] = x[k] + 0.1 * (-0.5 * np.sqrt(x[k]) + 0.5 * u[k])
    return Trajectory(u, x + 0.002 * rng.normal(size=len(x)), 0.1, "tank")


@pytest.fixture(scope="module")
def context() -> Context:
    physics = Physics(
        states=("level",),
        dynamics={"level": "-k1*sqrt(level) + k2*flow"},
        parameters={"k1": ParameterRange(0.05, 5.0), "k2": ParameterRange(0.05, 5.0)},
    )
    return Context(
        (Signal("flow"),), (Signal("level"),), 0.1, n_past_u=5, n_past_y=5, physics=physics, seed=1
    )


def suited(row: Family, record: Trajectory, context: Context) -> tuple[Trajectory, Context]:
    """The tank or, for families of several outputs, the tank and the integral of its level."""
    if "several" not in row.needs:
        return record, context
    y = np.concatenate([np.cumsum(record.y, axis=0) * record.sampling_time, record.y], axis=1)
    outputs = (Signal("sum"), *context.outputs)
    return Trajectory(record.u, y, 0.1, "tank"), replace(context, outputs=outputs, physics=None)


def small(settings: Settings, values: dict[str, int]) -> dict[str, int]:
    return {name: values[name] for name, _ in settings if name in values}


def quick_source(row: Family, record: Trajectory, context: Context) -> str:
    """The row's first candidate, small."""
    facts = Facts("", context.inputs, context.outputs, 0.1, (record,), 5, 5, context.physics)
    recipe = row.trial(facts)
    recipe = recipe.configured(**small(recipe.config, SMALL_CONFIG))
    return recipe.trained(**small(recipe.options, SMALL_METHOD)).source(row.label)


def test_every_family_has_one_row():
    modules = {module.name for module in pkgutil.iter_modules(asia.models.__path__)}
    public = {name for name in modules if not name.startswith("_")} - {"methods"}
    assert sorted(row.name for row in FAMILIES) == sorted(public)


@pytest.mark.parametrize("row", FAMILIES, ids=lambda row: row.name)
def test_a_model_comes_back_and_is_fitted_again_bitwise_the_same(row, record, context):
    record, context = suited(row, record, context)
    source = quick_source(row, record, context)
    assert f"import {row.name}\n" in source
    check_candidate(source, [record], context)


@pytest.mark.parametrize("row", FAMILIES, ids=lambda row: row.name)
def test_unequal_records_and_past_windows_of_unequal_length(row, record, context):
    record, context = suited(row, record, context)
    context = replace(context, n_past_u=2, n_past_y=6)
    records = [record[:120], record[120:]]
    module = types.ModuleType(row.name)
    exec(quick_source(row, record, context), module.__dict__)
    model = module.fit(records, context)
    y = model.simulate(record.u[None, 4:6], record.y[None, :6], record.u[None, 6:])
    assert y.shape == (1, len(record) - 6, context.ny)
    assert np.isfinite(y).all()
    assert np.std(y) > 0
