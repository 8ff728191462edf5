"""Storages in series, fitted without equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.agents.library.registry import family
from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.errors import UserError
from asia.models import compartments, linear
from asia.models._least_squares import LevenbergMarquardt
from tests.unit.models.systems.equations import context_for

DT = 2.0
# Names that no equation could hold, and one that is taken.
CONTEXT = replace(
    context_for(None, "u", "y", DT, seed=1),
    inputs=(Signal("pump (left)"),),
    outputs=(Signal("x0_0"),),
)
METHOD = LevenbergMarquardt(iterations=30, starts=3)


def record(seed: int, rising: bool = True, limit: float = np.inf) -> Trajectory:
    """Two storages that run off with the root of their content; the first loses what is too much,
    and the second gets half of it."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.0, 1.0, 20), 15)
    x, y = np.array([0.2, 0.2]), np.empty(len(u))
    for k, value in enumerate(u):
        y[k] = x[1]
        for _ in range(10):
            first, second = 0.07 * np.sqrt(np.maximum(x, 0.0))
            x = x + 0.1 * DT * np.array([0.06 * value - first, first - second])
            x = np.array([min(x[0], limit), x[1] + 0.5 * max(x[0] - limit, 0.0)])
    u = u if rising else 1.0 - u
    return Trajectory(u[:, None], 3.0 + 20.0 * y[:, None], DT, "r")


def error(model: object, on: Trajectory, context: Context) -> float:
    """Simulation error after the past window, over the deviation of the record."""
    past = max(context.n_past_u, context.n_past_y)
    y = model.simulate(on.u[None, :past], on.y[None, :past], on.u[None, past:])[0]  # type: ignore[attr-defined]
    return float(np.sqrt(np.mean((y - on.y[past:]) ** 2)) / on.y.std())


def trained(
    config: compartments.Config, on: Trajectory, context: Context = CONTEXT
) -> compartments.Compartments:
    return compartments.train(compartments.build(config, context), [on], context, METHOD)


def test_two_storages_are_found_in_a_record_in_which_nothing_is_named() -> None:
    train, unseen = record(0), record(1)
    found = error(trained(compartments.Config(), train), unseen, CONTEXT)
    best_linear = linear.train(
        linear.build(linear.Config(), CONTEXT), [train], CONTEXT, LevenbergMarquardt(iterations=20)
    )
    assert found < 0.02
    assert found < 0.2 * error(best_linear, unseen, CONTEXT)


def test_an_input_that_empties_is_known_from_the_record() -> None:
    model = trained(compartments.Config(), record(0, rising=False))
    assert error(model, record(1, rising=False), CONTEXT) < 0.02


@pytest.mark.slow
def test_a_storage_that_runs_over_needs_its_limit() -> None:
    train, unseen = record(2, limit=0.25), record(3, limit=0.25)
    plain = error(trained(compartments.Config(), train), unseen, CONTEXT)
    full = error(trained(compartments.Config(full=True, spill=True), train), unseen, CONTEXT)
    assert full < 0.5 * plain


@pytest.mark.parametrize("outflow", ["linear", "root", "power"])
def test_every_output_has_storages_that_all_inputs_fill(outflow: compartments.Outflow) -> None:
    one, other = record(0), record(1)
    both = replace(one, u=np.hstack([one.u, other.u]), y=np.hstack([one.y, -other.y]))
    context = replace(
        CONTEXT, inputs=(Signal("a"), Signal("b")), outputs=(Signal("c"), Signal("d"))
    )
    physics = compartments.balances(compartments.Config(3, outflow), [both], context)
    assert len(physics.states) == 6
    assert all(name in physics.dynamics["x1_0"] for name in ("a", "b"))
    assert ("power_0_0" in physics.parameters) == (outflow == "power")
    assert set(physics.observation) == {"c", "d"}


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(UserError, match="spill"):
        compartments.Config(spill=True)
    with pytest.raises(UserError, match="outflow"):
        compartments.Config(outflow="cubic")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="not trained"):
        compartments.build(compartments.Config(), CONTEXT).simulate(*np.zeros((3, 1, 5, 1)))


def test_the_library_leaves_them_out_of_windows_and_long_records() -> None:
    row = family("compartments")
    assert row is not None
    assert {"windows", "long"} <= row.unfit
