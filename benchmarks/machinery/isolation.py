"""Cost of each isolation level over a bare child process.

python benchmarks/machinery/isolation.py [--repeats 40]

A start is the time from the order to the worker's word that it is ready, its imports included. Bare
is the same worker with nothing around it and no layer put on. The levels take turns, so that a busy
machine is as busy for all of them, and each start is set against the bare one of its turn. Exits
with 1 when the median cost of a start is over the limit at any level.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from statistics import median, quantiles

from asia.judge.sandbox.availability import machine, open_worker, why_not
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker.worker import Worker

LIMIT_MS = 30.0
LIMITS = Limits(60.0, 60.0, 4096)


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=40)
    repeats: int = parser.parse_args().repeats
    ways = {"bare": bare}
    for level in Isolation:
        if why_not(level) is None:
            ways[level.value] = partial(open_worker, level, LIMITS)
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(repeats + 1):
        for name, way in ways.items():
            milliseconds = start(way)
            if turn > 0:  # the first turn reads files for all that follow
                times[name].append(milliseconds)
    here = machine()
    print(f"{here.system}, {here.cores} cores, Python {here.python}, {repeats} starts a level,")
    print(f"load {os.getloadavg()[0]:.1f}; milliseconds\n")
    print("| level | start, median | start, least | over bare, median | over bare, lower quarter |")
    print("|---|---|---|---|---|")
    over = False
    for name, starts in times.items():
        costs = [start - without for start, without in zip(starts, times["bare"], strict=True)]
        lower, middle, _ = quantiles(costs, n=4)
        over = over or middle > LIMIT_MS
        words = (median(starts), min(starts), middle, lower)
        print(f"| {name} | {' | '.join(f'{w:.1f}' for w in words)} |")
    return int(over)


def bare() -> Worker:
    """The worker's program as a plain child."""
    return Worker(LEVELS[Isolation.LANDLOCK].open(LIMITS, (), ()), LIMITS)


def start(way: Callable[[], Worker]) -> float:
    """Milliseconds until the worker is ready."""
    begin = time.perf_counter()
    with way() as worker:
        worker._start()
        return (time.perf_counter() - begin) * 1e3


if __name__ == "__main__":
    sys.exit(main())
