"""Every family: simulation, in one piece, equals its steps in NumPy and the lowered program."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.candidate import StepModel, simulate_steps
from asia.lowering.evaluation import simulate
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered_bytes
from asia.lowering.wire import unpack
from asia.models._networks.network import NetworkModel
from asia.models.physics_net import PhysicsNet
from tests.unit.export.models import MODELS, NU, NY, PAST, SCALING

from .test_simulation import cart, cart_context, requests, trained

DOUBLE, SINGLE = 1e-9, 1e-5
QUICK = ("linear with delay", "linear with levels", "neural_ss",
         "neural_ss with transport", "narx", "gp_narx", "esn with horizon", "gru")  # fmt: skip


def check_steps(model: Any, cases: list[Any], past: int, nu: int, ny: int) -> None:
    """Raises AssertionError where a fast path, the steps and the lowered program differ."""
    assert isinstance(model, StepModel)
    limit = SINGLE if isinstance(model, NetworkModel | PhysicsNet) else DOUBLE
    for past_u, past_y, u in cases:
        expected = model.simulate(past_u, past_y, u)
        size = np.abs(expected).max()
        stepped = simulate_steps(model, past_u, past_y, u)
        assert stepped.dtype == np.float64
        assert np.abs(stepped - expected).max() < limit * size
        # A row does not see its neighbours.
        alone = simulate_steps(model, past_u[-1:], past_y[-1:], u[-1:])
        assert np.abs(alone - stepped[-1:]).max() < limit * size
    program = unpack(lowered_bytes(model, past, past, nu, ny))
    assert isinstance(program, LoweredModel), program
    for past_u, past_y, u in cases:
        expected = model.simulate(past_u[:1], past_y[:1], u[:1, :100])[0]
        found = simulate(program, past_u[0], past_y[0], u[0, :100])
        assert np.abs(found - expected).max() < limit * np.abs(expected).max()


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in MODELS]
)
def test_simulation_equals_the_steps(name: str) -> None:
    """Unfitted parameters suffice for the comparison."""
    rng = np.random.default_rng(0)

    def case(batch: int, samples: int) -> tuple[Any, Any, Any]:
        past_u, u = (
            SCALING.u_mean + SCALING.u_std * rng.uniform(-1, 1, (batch, n, NU))
            for n in (PAST, samples)
        )
        return past_u, SCALING.y_mean + rng.uniform(-1, 1, (batch, PAST, NY)), u

    check_steps(MODELS[name](), [case(4, 30), case(1, 1)], PAST, NU, NY)


@pytest.mark.long
@pytest.mark.parametrize(
    "row", [pytest.param(r, id=r.name) for r in all_families() if "plant" not in r.needs]
)
def test_a_trained_model_equals_its_steps(row: Family) -> None:
    c = cart_context()
    check_steps(trained(row), requests(), c.n_past_u, c.nu, c.ny)


def broken(part: str) -> Callable[[], Any]:
    class Late(type(MODELS["linear"]())):  # pyright: ignore[reportUntypedBaseClass]
        def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
            state = super().initial(past_u, past_y, u)
            return super().step(state, u)[0] if part == "initial" else state

        def step(self, state: Any, u: Any) -> Any:
            after, y = super().step(state, u)
            return after, y + (1e-6 if part == "step" else 0.0)

    model = MODELS["linear"]()
    return lambda: Late(model.config, model.fitted, model.by_level)


@pytest.mark.parametrize("part", ["initial", "step"])
def test_the_suite_refuses_steps_of_another_model(part: str) -> None:
    record = cart()
    case = record.u[None, :PAST], record.y[None, :PAST], record.u[None, PAST:40]
    with pytest.raises(AssertionError):
        check_steps(broken(part)(), [case], PAST, NU, NY)
