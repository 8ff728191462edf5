"""Progress of a long command: the step that it works on, elapsed and remaining time."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic
from typing import TypeVar

T = TypeVar("T")
SILENCE = 4.0
"""Seconds between lines."""


@dataclass
class _Loop:
    """Loop of a command."""

    text: str
    total: int
    done: int = 0
    begin: float = field(default_factory=monotonic)
    stepped: float = field(default_factory=monotonic)
    """When a step of it, or of a loop inside it, was last completed."""


_LOOPS: ContextVar[list[_Loop] | None] = ContextVar("asia_progress", default=None)


def tracked(items: Sequence[T], text: str) -> Iterator[T]:
    """Yield items, and count them for the command that runs; for nobody elsewhere.

    Args:
        text: what is counted, such as `fold models`
    """
    loops = _LOOPS.get()
    if loops is None:
        yield from items
        return
    own = _Loop(text, len(items))
    loops.append(own)
    try:
        for item in items:
            yield item
            own.done += 1
            now = monotonic()
            for one in loops:
                one.stepped = now
    finally:
        if own in loops:
            loops.remove(own)


def now_doing(text: str) -> None:
    """Name what a command does that counts nothing, in place of what it did before."""
    loops = _LOOPS.get()
    if loops is not None:
        loops[:] = [*(one for one in loops if one.total), _Loop(text, 0)]


def progress_line(
    command: str, elapsed: float, loops: Sequence[tuple[str, int, int, float, float]]
) -> str:
    """One line on a command.

    Args:
        elapsed: seconds since its start
        loops: text, completed and all items of each loop (0 for a step that counts nothing),
            seconds from its start to its last completed step, and seconds since then, the outermost
            first
    """
    if not loops:
        return f"{command}: {elapsed:.0f} s"
    share = 0.0
    for _, done, total, *_ in reversed(loops):
        share = min((done + share) / max(total, 1), 1.0)
    steps = ", ".join(
        f"{text} {min(done + 1, n)} of {n}" if n else text for text, done, n, *_ in loops
    )
    # The longest known duration is that of the outermost loop.
    worked, since = loops[0][3:]
    left = worked * (1.0 - share) / share - since if share > 0 else 0.0
    # A step that lasts longer than those before it ends the estimate.
    return f"{command}: {elapsed:.0f} s, {steps}" + (f", about {left:.0f} s left" * (left >= 1))


@contextmanager
def reported(command: str, say: Callable[[str], None]) -> Generator[None]:
    """Print a line on a command from time to time while it runs.

    Args:
        say: prints a line
    """
    loops, done, begin = list[_Loop](), Event(), monotonic()

    def watch() -> None:
        while not done.wait(SILENCE):
            now = monotonic()
            known = [
                (one.text, one.done, one.total, one.stepped - one.begin, now - one.stepped)
                for one in tuple(loops)
            ]
            say(progress_line(command, now - begin, known))

    token = _LOOPS.set(loops)
    thread = Thread(target=watch, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        _LOOPS.reset(token)
