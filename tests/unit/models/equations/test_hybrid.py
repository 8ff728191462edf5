"""The hybrid on a system whose equations lack a part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asia.data import Trajectory
from asia.models import greybox, hybrid
from asia.models._least_squares import LevenbergMarquardt
from tests.unit.models.systems.equations import DUFFING, context_for, duffing_record

METHOD = LevenbergMarquardt(iterations=40, starts=4)
SPRING_UNKNOWN = replace(
    DUFFING,
    parameters={k: DUFFING.parameters[k] for k in ("c", "k", "b")},
    dynamics={"position": "velocity", "velocity": "-c*velocity - k*position + b*force"},
)


def error(model: greybox.GreyBox, record: Trajectory) -> float:
    y = model.simulate(record.u[None, :5], record.y[None, :5], record.u[None, 5:])[0]
    return float(np.sqrt(np.mean((y - record.y[5:]) ** 2)))


@pytest.mark.long
def test_network_learns_the_hardening_spring_that_the_equations_lack() -> None:
    context = context_for(SPRING_UNKNOWN, "force", "y", 0.15)
    records, new = [duffing_record(300, 0, 0.01)], duffing_record(200, 8)
    grey = greybox.train(greybox.build(greybox.Config(), context), records, context, METHOD)
    config = hybrid.Config(units=3, ridge=1e-5)
    whole = hybrid.train(hybrid.build(config, context), records, context, METHOD)
    assert error(whole, records[0]) < error(grey, records[0])
    assert error(whole, new) < 0.4 * error(grey, new)


def test_a_problem_without_physics_is_refused() -> None:
    with pytest.raises(ValueError, match=r"hybrid: the problem has no \[physics\]"):
        hybrid.build(hybrid.Config(), context_for(None, "force", "y", 0.15))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="units"):
        hybrid.Config(units=0)
    with pytest.raises(ValueError, match="ridge"):
        hybrid.Config(ridge=-1.0)
    with pytest.raises(ValueError, match="not in base"):
        hybrid.Config(base=greybox.Config(residual=3))
