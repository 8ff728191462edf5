"""What the order in which experiments get workers is worth, on a simulated clock.

python benchmarks/searches/schedule.py [--searches 60] [--experiments 30]

Draws searches whose fits have lognormal times and of which about a third is retested and checked,
lays their jobs out on so many workers by each rule of docs/design/parallel.md, and prints the mean
speed-up over one worker. Nothing is fitted and no time is measured.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import random
from dataclasses import dataclass, field
from statistics import mean

RETESTS, KEPT = 2, 0.35
SIZES = ((2, 2), (2, 3), (4, 8), (8, 8), (8, 16))
SPARE = 10**6
"""The turn of a retest that nobody has asked for."""
Name = tuple[str, int, int]
"""What a group of jobs is, of which experiment, and its number there."""
Seconds = list[float]
"""Of the folds of one fit or check."""


@dataclass(frozen=True)
class Rule:
    """Who gets a worker, and when."""

    words: str
    turns: bool
    """The oldest experiment goes first; else first come, first served."""
    beside: bool
    """The checks of a new best begin with its retests."""
    spare: bool
    """The next retest begins where a worker is free, and is ended if nobody asks for it."""


RULES = (
    Rule("first come, first served", turns=False, beside=False, spare=False),
    Rule("by turn, checks beside", turns=True, beside=True, spare=False),
    Rule("and the next retest beside", turns=True, beside=True, spare=True),
)


@dataclass(frozen=True)
class Experiment:
    """What an experiment takes."""

    first: Seconds
    retests: list[Seconds]
    checks: Seconds
    unasked: Seconds
    """A retest that its outcome makes needless."""


@dataclass
class Group:
    """Jobs that are waited for together."""

    left: int
    turn: int


@dataclass
class Clock:
    """Workers and who waits for them."""

    free: int
    turns: bool
    now: float = 0.0
    groups: dict[Name, Group] = field(default_factory=dict)
    waiting: list[tuple[int, int, Name, float]] = field(default_factory=list)
    running: list[tuple[float, int, Name]] = field(default_factory=list)
    numbers: itertools.count[int] = field(default_factory=itertools.count)

    def ask(self, name: Name, seconds: Seconds, turn: int) -> None:
        """For a group of jobs, or for an earlier turn of one that was asked for."""
        known = self.groups.get(name)
        place = turn if self.turns or turn == SPARE else 0
        if known is None:
            self.groups[name] = Group(len(seconds), turn)
            for one in seconds:
                heapq.heappush(self.waiting, (place, next(self.numbers), name, one))
        elif turn < known.turn:
            known.turn = turn
            self.waiting = [(place if w[2] == name else w[0], *w[1:]) for w in self.waiting]
            heapq.heapify(self.waiting)

    def ended(self, name: Name) -> bool:
        """Whether all jobs of a group have ended."""
        return name in self.groups and self.groups[name].left == 0

    def drop(self, name: Name) -> None:
        """End a group that nobody asks for."""
        self.waiting = [w for w in self.waiting if w[2] != name]
        kept = [r for r in self.running if r[2] != name]
        self.free += len(self.running) - len(kept)
        self.running = kept
        heapq.heapify(self.waiting)
        heapq.heapify(self.running)

    def go_on(self) -> None:
        """To the end of the next job."""
        while self.free and self.waiting:
            _, _, name, seconds = heapq.heappop(self.waiting)
            self.free -= 1
            heapq.heappush(self.running, (self.now + seconds, next(self.numbers), name))
        self.now, _, name = heapq.heappop(self.running)
        self.free += 1
        self.groups[name].left -= 1


def seconds_of(experiments: list[Experiment], workers: int, in_flight: int, rule: Rule) -> float:
    """Until the last one is recorded."""
    clock, oldest, proposed = Clock(workers, rule.turns), 0, 0
    while oldest < len(experiments):
        while proposed < min(oldest + in_flight, len(experiments)):
            clock.ask(("fit", proposed, 0), experiments[proposed].first, proposed + 1)
            proposed += 1
        if _decided(clock, oldest, experiments[oldest], rule):
            oldest += 1
        else:
            clock.go_on()
    return clock.now


def _decided(clock: Clock, number: int, one: Experiment, rule: Rule) -> bool:
    """Whether the experiment has all that its record needs; asks for what is missing."""
    if not clock.ended(("fit", number, 0)):
        return False
    check = ("check", number, 0)
    if one.checks and rule.beside:
        clock.ask(check, one.checks, 0)
    for k, seconds in enumerate(one.retests):
        clock.ask(("retest", number, k), seconds, 0)
        if rule.spare and k + 1 < RETESTS:
            following = one.retests[k + 1] if k + 1 < len(one.retests) else one.unasked
            clock.ask(("retest", number, k + 1), following, SPARE)
        if not clock.ended(("retest", number, k)):
            return False
    for k in range(len(one.retests), RETESTS):
        clock.drop(("retest", number, k))
    if one.checks:
        clock.ask(check, one.checks, 0)
    return not one.checks or clock.ended(check)


def drawn(count: int, folds: int, rng: random.Random) -> list[Experiment]:
    """Experiments of one search."""
    found: list[Experiment] = []
    for _ in range(count):
        usual, kept = rng.lognormvariate(1.5, 1.0), rng.random() < KEPT
        fits = [[usual * rng.uniform(0.7, 1.3) for _ in range(folds)] for _ in range(RETESTS + 2)]
        retests = fits[1 : 1 + rng.choice([1, RETESTS])] if kept else []
        checks = [rng.uniform(0.3, 2.0) for _ in range(folds)] if kept else []
        found.append(Experiment(fits[0], retests, checks, fits[-1]))
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--searches", type=int, default=60)
    parser.add_argument("--experiments", type=int, default=30)
    options = parser.parse_args()
    searches = {
        folds: [
            drawn(options.experiments, folds, random.Random(s)) for s in range(options.searches)
        ]
        for folds in (2, 5)
    }
    print("| workers, in flight | " + " | ".join(rule.words for rule in RULES) + " |")
    print("|---" * (1 + len(RULES)) + "|")
    for workers, in_flight in SIZES:
        cells = []
        for rule in RULES:
            each = [
                mean(
                    seconds_of(one, 1, 1, RULES[0]) / seconds_of(one, workers, in_flight, rule)
                    for one in some
                )
                for some in searches.values()
            ]
            cells.append(", ".join(f"{value:.2f}" for value in each))
        print(f"| {workers}, {in_flight} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
