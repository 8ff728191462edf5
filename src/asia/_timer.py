"""Profile of a search by activity. Measured times are displayed and decide nothing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeVar

T = TypeVar("T")


def duration(seconds: float) -> str:
    """`7s`, `3m05s` or `1h02m`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole}s"
    if whole < 3600:
        return f"{whole // 60}m{whole % 60:02d}s"
    return f"{whole // 3600}h{whole % 3600 // 60:02d}m"


class Activity(StrEnum):
    """Activity that time is spent on, in the order of a table."""

    PREPARE = "prepare"
    """The problem is read and checked, the levels of isolation are tried out."""
    START = "workers"
    """Workers start, load what they need before they are asked anything, and end."""
    IMPORT = "import"
    """Executing the candidate, with what it imports, or loading a stored model."""
    TRACE = "trace"
    """JAX traces and lowers a program."""
    COMPILE = "compile"
    """XLA compiles it."""
    FIT = "fit"
    """Remaining time of a fit."""
    SIMULATE = "simulate"
    """Remaining time of a simulation."""
    CHECKS = "checks"
    """Reproduction of a new best and checks of its model."""
    SCORE = "score"
    """Errors and residuals."""
    REFERENCES = "references"
    """The reference models are scored."""
    REFIT = "refit"
    """The best candidate fitted on all records, and a second time on a fold."""
    GUARD = "guard"
    """The look at the guard records."""
    AGENT = "agent"
    """A proposal is made."""
    LEDGER = "ledger"
    """Lines and artifacts are written."""
    PICTURES = "pictures"
    """The report is drawn."""
    IDLE = "idle"
    """Pause by the user."""
    OTHER = "other"
    """Time of no other activity."""

    @classmethod
    def _missing_(cls, value: object) -> Activity | None:
        """Older ledgers call the references rungs."""
        return cls.REFERENCES if value == "rungs" else None


@dataclass(frozen=True)
class TimeSpent:
    """Seconds of one activity."""

    activity: Activity
    wall: float
    """Wall-clock time on the critical path, s: of concurrent jobs, that of the thread that ends
    last."""
    processor: float
    """Processor time over all workers and threads, s."""


Seconds = dict[Activity, tuple[float, float]]


def add_seconds(spent: Seconds, activity: Activity, wall: float, processor: float) -> None:
    """Add to `spent`, in place."""
    before = spent.get(activity, (0.0, 0.0))
    spent[activity] = (before[0] + wall, before[1] + processor)


@dataclass
class _Open:
    """An activity under way."""

    swallows: Activity | None = None
    """Activity that all nested activities count as."""
    wall: float = 0.0
    """Wall seconds of the activities within it."""
    processor: float = 0.0
    """Processor seconds of this thread in them."""


@dataclass
class Lane:
    """Profile of one thread."""

    spent: Seconds = field(default_factory=dict[Activity, tuple[float, float]])
    under_way: list[_Open] = field(default_factory=list[_Open])
    ended: float = 0.0


class ActivityTimer:
    """Adds up seconds by activity, of the thread that made it and of the jobs that it runs. An
    activity inside another one is not counted twice."""

    def __init__(self) -> None:
        self._lanes = threading.local()
        self._main = self._lanes.now = Lane()
        self._begin = time.monotonic()

    @contextmanager
    def activity(self, activity: Activity, *, swallows: bool = False) -> Generator[None]:
        """Count the time in here as `activity`; with `swallows` those in it too."""
        lane = self._lane
        if lane is None:
            yield
            return
        opened = _Open(swallows=activity if swallows else None)
        lane.under_way.append(opened)
        begin, begin_processor = time.monotonic(), time.thread_time()
        try:
            yield
        finally:
            wall = time.monotonic() - begin
            processor = time.thread_time() - begin_processor
            lane.under_way.pop()
            own = max(0.0, wall - opened.wall)
            self.add(activity, own, max(0.0, processor - opened.processor))
            if lane.under_way:
                lane.under_way[-1].wall += wall - own
                lane.under_way[-1].processor += processor

    def add(self, activity: Activity, wall: float, processor: float) -> None:
        """Count seconds that were measured elsewhere and passed in this thread."""
        lane = self._lane
        if lane is None:
            return
        outer = next((o.swallows for o in lane.under_way if o.swallows is not None), None)
        add_seconds(lane.spent, outer or activity, wall, processor)
        if lane.under_way:
            lane.under_way[-1].wall += wall

    def run(
        self, run: Callable[[Sequence[Callable[[], T]]], list[T]], jobs: Sequence[Callable[[], T]]
    ) -> list[T]:
        """`run(jobs)`. Of jobs in several threads the wall seconds of the last one to end count."""
        lanes: dict[int, Lane] = {}

        def timed(job: Callable[[], T]) -> T:
            with self.aside(lanes.setdefault(threading.get_ident(), Lane())) as lane:
                try:
                    return job()
                finally:
                    lane.ended = time.monotonic()

        begin = time.thread_time()
        try:
            return run([lambda job=job: timed(job) for job in jobs])
        finally:
            longest = max(lanes.values(), key=lambda lane: lane.ended, default=None)
            for lane in list(lanes.values()):
                for activity, (wall, processor) in list(lane.spent.items()):
                    self.add(activity, wall if lane is longest else 0.0, processor)
            if self._lane is not None and self._lane.under_way:
                self._lane.under_way[-1].processor += time.thread_time() - begin

    @contextmanager
    def aside(self, own: Lane | None = None) -> Generator[Lane]:
        """Count the time of this thread separately, for the thread that waits for it."""
        before, own = self._lane, own or Lane()
        self._lanes.now = own
        try:
            yield own
        finally:
            self._lanes.now = before

    def waited(self, lane: Lane, seconds: float) -> None:
        """Count what was spent aside. Wall seconds are only those of the wait for it, in the shares
        that its activities have."""
        total = sum(wall for wall, _ in lane.spent.values())
        share = seconds / total if total > 0 else 0.0
        for activity, (wall, processor) in list(lane.spent.items()):
            self.add(activity, wall * share, processor)

    def take(self) -> tuple[TimeSpent, ...]:
        """Return the times since the last call, without zeros."""
        spent, self._main.spent = self._main.spent, {}
        now = time.monotonic()
        elapsed, self._begin = now - self._begin, now
        known = sum(wall for wall, _ in spent.values())
        add_seconds(spent, Activity.OTHER, max(0.0, elapsed - known), 0.0)
        rounded = [
            TimeSpent(one, *(round(seconds, 4) for seconds in spent[one]))
            for one in Activity
            if one in spent
        ]
        return tuple(one for one in rounded if one.wall or one.processor)

    def only(self, *wanted: Activity) -> tuple[TimeSpent, ...]:
        """Return the times of these activities, see `take`."""
        return tuple(one for one in self.take() if one.activity in wanted)

    @property
    def _lane(self) -> Lane | None:
        """Profile of this thread; None in a thread without a job."""
        return getattr(self._lanes, "now", None)
