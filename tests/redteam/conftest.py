import os
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.sandbox.availability import open_worker, why_not
from asia.judge.sandbox.types import Isolation, Layer, Limits
from tests.redteam.attacks import source as source_of
from tests.redteam.evidence import said_steps

REASONS = {level: why_not(level) for level in Isolation if level is not Isolation.SANDBOX_EXEC}
LEVELS = {
    level: pytest.param(level, marks=pytest.mark.skipif(reason is not None, reason=str(reason)))
    for level, reason in REASONS.items()
}
WALLED = [LEVELS[Isolation.NAMESPACE], LEVELS[Isolation.LANDLOCK]]

# What the machine holds in memory decides whether a whisper fails or says nothing.
BY_CHANCE = {42}


def candidate(
    fit: str = "pass", before: str = "pass", after: str = "0.5 * u", top: str = ""
) -> str:
    """Make a candidate as in the suite, with another honest simulation."""
    return source_of.candidate(fit, before, after, top)


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

    def filled(self, source: str) -> str:
        """The source with what it receives."""
        return source.replace("GIVEN", repr({"MARK": self.mark})).replace("CRUDE", "(0.5, 0.5)")

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
            self.reply = worker.fit(self.filled(source), self.records, self.context)
            if dump:
                worker.dump()
            first = worker.simulate(self.past, self.past, self.u)
            second = worker.simulate(self.past, self.past, self.u)
            np.testing.assert_array_equal(first, second)
            return first

    def gains_nothing(self, source: str, without: tuple[Layer, ...] = ()) -> None:
        np.testing.assert_array_equal(self.run(source, without=without), 0.5 * self.u)

    def ends(self, attempts: Mapping[str, str]) -> dict[str, str]:
        """Run each of these codes in one worker; return an error's name or `done` for each."""
        with open_worker(self.level, Limits(30.0, 30.0, 2048, 64)) as worker:
            source = self.filled(source_of.steps(attempts))
            return said_steps(worker.fit(source, self.records, self.context)[1])

    def survivors(self) -> list[str]:
        """Processes of this arena that still live, zombies included."""
        found: list[str] = []
        for pid in os.listdir("/proc"):
            try:
                text = Path(f"/proc/{pid}/stat").read_text()
            except OSError:
                continue
            if f"({self.mark})" in text:
                found.append(text)
        return found


@contextmanager
def arena_at(level: Isolation) -> Iterator[Arena]:
    """An arena that must be found empty when it closes."""
    arena = Arena(level)
    yield arena
    end = time.monotonic() + 5  # outside the namespace its dead may be listed for a moment
    while arena.survivors() and time.monotonic() < end:
        time.sleep(0.01)
    assert arena.survivors() == []


@pytest.fixture(params=WALLED, ids=str)
def arena(request: pytest.FixtureRequest) -> Iterator[Arena]:
    """Arena at the levels that confine malicious candidates."""
    with arena_at(request.param) as arena:
        yield arena


@pytest.fixture
def open_arena() -> Iterator[Arena]:
    """Open an arena at the weakest level, where only the parent protects itself."""
    with arena_at(Isolation.PROCESS) as arena:
        yield arena


def page_tables() -> dict[tuple[str, ...], list[dict[str, str]]]:
    """The tables of docs/redteam.md by their heads, a row as words by column."""
    page = (Path(__file__).parents[2] / "docs" / "redteam.md").read_text()
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    head: tuple[str, ...] = ()
    for line in page.splitlines():
        cells = tuple(cell.strip() for cell in line.strip("|").split("|"))
        if not line.startswith("|"):
            head = ()
        elif not head:
            head = cells
            found[head] = []
        elif set(line) - set("|-"):
            found[head].append(dict(zip(head, cells, strict=True)))
    return found
