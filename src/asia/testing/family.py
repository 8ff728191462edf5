"""Conformance suite for model families of the library."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from asia._plugins import family_module
from asia.agents.library.family import Family
from asia.agents.view import Facts
from asia.candidate import Context
from asia.data.trajectory import Signal, Trajectory
from asia.models import methods
from asia.problem.plant import Plant, Unknown
from asia.recipe import Recipe, read_recipe
from asia.testing.candidate import check_candidate, tank, tank_context

_TANK = Plant(
    source="tank.py:simulate",
    parameters={"k1": Unknown(0.05, 5.0), "k2": Unknown(0.05, 5.0)},
    initial={"level": Unknown(0.0, 5.0)},
    code=b"""
def simulate(u, params, x0, dt):
    level, y = x0["level"], []
    for (flow,) in u:
        y.append(level)
        level = max(level + dt * (params["k2"] * flow - params["k1"] * level**0.5), 0.0)
    return y
""",
)


def check_family(row: Family) -> None:
    """Fit the family at the size of tests to a made-up tank.

    Checked: first and long configuration, and those of its other training methods, are accepted by
    the family and the method, and read back from their sources; the smallest one is a candidate as
    `check_candidate` wants it; it is fitted to records of unequal length and simulates after past
    windows of unequal length.
    """
    record, context = family_problem(row)
    facts = _facts(record, context)
    for recipe in (row.trial(facts), row.full(facts), row.smallest(facts)):
        check_recipe(recipe)
        for change in row.methods:
            check_recipe(change(facts, recipe))
    check_candidate(row.smallest(facts).source(row.label), [record], context)
    context = replace(context, n_past_u=2, n_past_y=6)
    module = types.ModuleType(row.name)
    exec(smallest_source(row, record, context), module.__dict__)
    model = module.fit([record[:120], record[120:]], context)
    y = model.simulate(record.u[None, 4:6], record.y[None, :6], record.u[None, 6:])
    assert y.shape == (1, len(record) - 6, context.ny), f"y_hat has shape {y.shape}"
    assert np.isfinite(y).all(), "y_hat is not finite"
    assert np.std(y) > 0, "no output moves"


def check_recipe(recipe: Recipe) -> None:
    """Check that the family's `Config` and the method accept the settings, and that the source
    reads back.

    Raises:
        UserError: for a setting that they do not accept
    """
    family_module(recipe.package, recipe.family).Config(**dict(recipe.config))
    method: Callable[..., object] = getattr(methods, recipe.method)
    method(**dict(recipe.options))
    assert read_recipe(recipe.source("Anything.")) == recipe, "the source does not read back"


def family_problem(row: Family) -> tuple[Trajectory, Context]:
    """A leaking tank or, for families of several outputs, the tank and the integral of its
    level; for those that need one, with a simulator of the tank."""
    record, context = tank(), tank_context()
    if "plant" in row.needs:
        context = replace(context, plant=_TANK)
    if "several" not in row.needs:
        return record, context
    y = np.concatenate([np.cumsum(record.y, axis=0) * record.sampling_time, record.y], axis=1)
    outputs = (Signal("sum"), *context.outputs)
    return Trajectory(record.u, y, 0.1, "tank"), replace(context, outputs=outputs, physics=None)


def smallest_source(row: Family, record: Trajectory, context: Context) -> str:
    """The candidate that the family is tested with."""
    return row.smallest(_facts(record, context)).source(row.label)


def _facts(record: Trajectory, context: Context) -> Facts:
    return Facts(**context.known(), records=(record,))
