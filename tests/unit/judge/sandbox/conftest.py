from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.sandbox.availability import open_worker, probe, why_not
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker

REASONS = {level: why_not(level) for level in Isolation if level is not Isolation.SANDBOX_EXEC}
LEVELS = [
    pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level, reason in REASONS.items()
]


# The contract of a worker is checked at each level by `check_sandbox`; what does not depend on the
# layers is tested at one.
one_level = pytest.mark.parametrize("level", [probe().level], ids=str)


@dataclass(frozen=True)
class Case:
    trajectories: tuple[Trajectory, ...]
    context: Context
    past_u: np.ndarray
    past_y: np.ndarray
    u: np.ndarray


@pytest.fixture
def case() -> Case:
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(200, 1)), rng.normal(size=(200, 2))
    return Case(
        (Trajectory(u, y, 0.1, "first"), Trajectory(u[:50], y[:50], 0.1, "second")),
        Context((Signal("u"),), (Signal("y1"), Signal("y2")), 0.1, 5, 3),
        rng.normal(size=(3, 5, 1)),
        rng.normal(size=(3, 3, 2)),
        rng.normal(size=(3, 40, 1)),
    )


@pytest.fixture(params=LEVELS)
def level(request: pytest.FixtureRequest) -> Isolation:
    return request.param


@pytest.fixture
def worker(level: Isolation) -> Callable[..., Worker]:
    def make(**changes: float) -> Worker:
        return open_worker(level, replace(Limits(60.0, 30.0, 4096), **changes))

    return make
