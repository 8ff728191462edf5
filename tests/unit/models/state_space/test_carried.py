"""A state-space model whose inputs are carried at the pace of one of them."""

from __future__ import annotations

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import neural_ss
from asia.models._least_squares import LevenbergMarquardt
from tests.unit.models.systems.transport import belt

CONTEXT = Context((Signal("speed"), Signal("load")), (Signal("y"),), 1.0, 15, 15)
METHOD = LevenbergMarquardt(iterations=15, starts=1)


def error(config: neural_ss.Config) -> float:
    model = neural_ss.train(neural_ss.build(config, CONTEXT), [belt(400, 0)], CONTEXT, METHOD)
    fresh = belt(300, 1, noise=0.0)
    y = simulated(model, fresh)
    return float(np.sqrt(np.mean((y - fresh.y[15:]) ** 2)) / fresh.y.std())


def simulated(model: neural_ss.NeuralStateSpace, record: Trajectory) -> Array:
    return model.simulate(record.u[None, :15], record.y[None, :15], record.u[None, 15:])[0]


@pytest.mark.slow
def test_the_delay_that_an_input_sets_is_followed() -> None:
    plain = neural_ss.Config(order=2, nonlinearity="none", delay=None)
    assert error(plain) > 0.4
    assert error(neural_ss.Config(order=2, nonlinearity="none", transport=0)) < 0.15


@pytest.mark.parametrize(("pace", "words"), [(1, "not positive"), (2, "less than 2")])
def test_a_pace_that_is_none_is_refused(pace: int, words: str) -> None:
    model = neural_ss.build(neural_ss.Config(transport=pace), CONTEXT)
    with pytest.raises(UserError, match=words):
        neural_ss.train(model, [belt(200, 0)], CONTEXT, METHOD)


def test_symmetries_of_plain_inputs_are_refused_with_it() -> None:
    with pytest.raises(UserError, match="symmetry"):
        neural_ss.Config(transport=0, symmetry=True)
