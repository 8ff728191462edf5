import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

from asia.candidate import Context
from asia.problem import Signal, Trajectory
from asia.sandbox import Isolation, Layer, Limits, open_worker, why_not

REASONS = {level: why_not(level) for level in Isolation if level is not Isolation.SANDBOX_EXEC}
LEVELS = {
    level: pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level, reason in REASONS.items()
}
MARK_PROCESS = """
import ctypes
ctypes.CDLL(None).prctl(15, b"{mark}", 0, 0, 0)
"""


@dataclass
class Arena:
    """Runs one attack at one level and looks for what it left behind."""

    level: Isolation
    mark: str = field(default_factory=lambda: "rt" + secrets.token_hex(5))

    def __post_init__(self) -> None:
        rng = np.random.default_rng(1)
        self.u = rng.normal(size=(2, 30, 1))
        self.past = rng.normal(size=(2, 4, 1))
        record = Trajectory(rng.normal(size=(80, 1)), rng.normal(size=(80, 1)), 1.0, "train")
        self.records = [record]
        self.context = Context((Signal("u"),), (Signal("y"),), 1.0, 4, 4)

    def run(
        self,
        source: str,
        *,
        fit_seconds: float = 30.0,
        simulate_seconds: float = 30.0,
        memory_mb: int = 2048,
        model_mb: int = 64,
        dump: bool = False,
        without: tuple[Layer, ...] = (),
    ) -> np.ndarray:
        limits = Limits(fit_seconds, simulate_seconds, memory_mb, model_mb)
        with open_worker(self.level, limits, without=without) as worker:
            marked = MARK_PROCESS.format(mark=self.mark) + source
            self.reply = worker.fit(marked, self.records, self.context)
            if dump:
                worker.dump()
            first = worker.simulate(self.past, self.past, self.u)
            second = worker.simulate(self.past, self.past, self.u)
            np.testing.assert_array_equal(first, second)
            return first

    def survivors(self) -> list[str]:
        """Processes of this arena that still live, zombies included."""
        found: list[str] = []
        for pid in os.listdir("/proc"):
            try:
                with open(f"/proc/{pid}/stat") as file:
                    text = file.read()
            except OSError:
                continue
            if f"({self.mark})" in text:
                found.append(text)
        return found

    @property
    def walled(self) -> bool:
        """Whether the level means to stop intent, not only accidents."""
        return self.level is not Isolation.PROCESS


@contextmanager
def arena_at(level: Isolation) -> Iterator[Arena]:
    """An arena that must be found empty when it closes."""
    arena = Arena(level)
    yield arena
    end = time.monotonic() + 5  # outside the namespace its dead may be listed for a moment
    while arena.survivors() and time.monotonic() < end:
        time.sleep(0.01)
    assert arena.survivors() == []


@pytest.fixture(params=LEVELS.values(), ids=str)
def arena(request: pytest.FixtureRequest) -> Iterator[Arena]:
    with arena_at(request.param) as arena:
        yield arena
