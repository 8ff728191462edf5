"""Run directories with a queue, and the processes that empty them."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from asia.agents import Proposal
from asia.interfaces.workspace.process import SearchRequest, prepare_request
from asia.interfaces.workspace.server import RunDesk
from asia.ledger.chain import Chain
from asia.ledger.events import Event
from tests.unit.search.toy import arx, write_problem

LONGEST = 120.0


def order(problem: Path, experiments: int | None = 4, seed: int = 0) -> SearchRequest:
    return SearchRequest(problem=str(problem), agent="mcp", seed=seed, experiments=experiments)


def candidate(
    order: int = 2, hypothesis: str = "one more lag", parent: int | None = None
) -> Proposal:
    return Proposal(arx(order), "", "", hypothesis, "a lower V", parent)


@dataclass(frozen=True)
class Place:
    """A run directory with its order; no search has begun yet."""

    problem: Path
    directory: Path

    @property
    def desk(self) -> RunDesk:
        """Nobody is called to empty it."""
        return RunDesk(self.directory)

    def append(self, *events: Event) -> None:
        """Write the ledger on by hand."""
        with Chain(self.directory / "ledger.jsonl") as chain:
            for event in events:
                chain.append(event)


def ordered(root: Path, experiments: int | None = 4) -> Place:
    problem = write_problem(root / "toy", experiments=4)
    wanted = order(problem, experiments)
    directory = prepare_request(wanted, root / "runs", None).directory
    wanted.save(directory)
    return Place(problem, directory)


def searches(directory: Path) -> list[int]:
    """The processes that empty this run's queue. What one of them has just forked is not one."""
    found: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
            if b"asia.interfaces.workspace" in words and os.fsencode(directory.resolve()) in words:
                found[int(entry.name)] = parent
    return [pid for pid, parent in found.items() if parent not in found]


def end_searches(directory: Path) -> None:
    """Kill them, and wait until they are gone."""
    end = time.monotonic() + LONGEST
    while found := searches(directory):
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        assert time.monotonic() < end, "a search does not end"
        time.sleep(0.02)
