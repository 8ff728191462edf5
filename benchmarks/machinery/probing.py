"""Score probing: what an agent reads out of 200 scores.

Each query is a baseline's simulation of the held-out parts plus a known pattern, a cosine; it is
scored as the search does it. No sandbox is needed: no candidate runs.

    python benchmarks/machinery/probing.py [--queries 200] [--problem two_tanks_sim]

Regression: the scores of all patterns give the error's component along each, and the sum of them is
taken off (needs a score that moves). Climbing: a pattern that is told to be a new best stays (needs
one bit), tried in one fold, in all together, or as random mixtures. Printed is the true V after
each, for the best of some sizes of pattern: what a search would take for progress. On other data
the patterns help nobody.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from asia.candidate import Context
from asia.data import Array
from asia.judge.scoring.outcome import Failure, Score, score_outputs
from asia.models import linear
from asia.models._least_squares import LevenbergMarquardt
from asia.problem.folds import Fold, make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem

Outputs = list[list[Array]]
AMPLITUDES = (0.03, 0.1, 0.3, 0.6)


@dataclass
class Attacked:
    """Scores simulations, and tells V of each fold. digits: significant ones of every score told,
    None for all."""

    folds: Sequence[Fold]
    metric: str
    digits: int | None = None
    lowest: float = field(default=math.inf, init=False)

    def true(self, outputs: Outputs) -> Score:
        """All of V."""
        score = score_outputs(self.folds, outputs, self.metric)
        assert not isinstance(score, Failure)
        return score

    def ask(self, outputs: Outputs) -> tuple[bool, tuple[float, ...]]:
        """Whether it is a new best, and the V of each fold that an agent sees."""
        score = self.true(outputs)
        new_best, self.lowest = score.value < self.lowest, min(score.value, self.lowest)
        numbers = [fold.value for fold in score.folds]
        if self.digits is not None:
            numbers = [float(f"{v:.{self.digits - 1}e}") for v in numbers]
        return new_best, tuple(numbers)


def baseline(problem: Problem, folds: Sequence[Fold]) -> Outputs:
    """The best linear model's simulation of every held-out block."""
    rule, found = problem.protocol, []
    context = Context(
        problem.inputs, problem.outputs, problem.sampling_time, rule.past_inputs,
        rule.past_outputs, rule.horizon,
    )  # fmt: skip
    for fold in folds:
        model = linear.build(linear.Config(order=None, delay=None), context)
        model = linear.train(model, fold.train, context, LevenbergMarquardt(iterations=30))
        cases = list(fold.held_out)
        found.append(
            [
                np.asarray(model.simulate(c.past_u[None], c.past_y[None], c.u[None])[0])
                for c in cases
            ]
        )
    return found


def pattern(folds: Sequence[Fold], k: int, sizes: Sequence[float]) -> Outputs:
    """The k-th cosine along each held-out block, `sizes[f]` standard deviations high in fold f."""
    return [
        [
            size * fold.scale * np.cos(np.pi * k * (np.arange(len(b.y))[:, None] + 0.5) / len(b.y))
            for b in fold.held_out
        ]
        for fold, size in zip(folds, sizes, strict=True)
    ]


def plus(one: Outputs, other: Outputs, factor: float = 1.0) -> Outputs:
    return [
        [a + factor * b for a, b in zip(x, y, strict=True)] for x, y in zip(one, other, strict=True)
    ]


def regression(desk: Attacked, start: Outputs, queries: int, size: float) -> Outputs:
    """From mean((e + c)^2) = mean(e^2) + 2 mean(e c) + mean(c^2): one component a query, for all
    folds at once."""
    folds, found = desk.folds, start
    _, first = desk.ask(start)
    for k in range(queries - 1):
        probe = pattern(folds, k, [size] * len(folds))
        _, told = desk.ask(plus(start, probe))
        taken = [0.0] * len(folds)
        for f, (a, b) in enumerate(zip(told, first, strict=True)):
            change = a**2 - b**2
            power = float(np.mean(np.concatenate([(c / folds[f].scale) ** 2 for c in probe[f]])))
            taken[f] = -0.5 * (change - power) / power * size if change else 0.0
        found = plus(found, pattern(folds, k, taken))
    return found


def climbing(desk: Attacked, start: Outputs, queries: int, size: float) -> Outputs:
    """Keep each change that is reported as a new best, one pattern of one fold after the other."""
    count = len(desk.folds)
    moves = [np.eye(count)[f] * sign for f in range(count) for sign in (size, -size)]
    tries = (pattern(desk.folds, k, move) for k in range(queries) for move in moves)
    return _climbed(desk, start, queries, tries)


def together(desk: Attacked, start: Outputs, queries: int, size: float) -> Outputs:
    """The same, in all folds at once, with all combinations of signs."""
    moves = list(itertools.product((size, -size), repeat=len(desk.folds)))
    tries = (pattern(desk.folds, k, move) for k in range(queries) for move in moves)
    return _climbed(desk, start, queries, tries)


def mixtures(desk: Attacked, start: Outputs, queries: int, size: float) -> Outputs:
    """The same, with random sums of the slowest patterns."""
    random = np.random.default_rng(0)

    def mixture() -> Outputs:
        found = pattern(desk.folds, 0, random.normal(size=len(desk.folds)) * size)
        for k in range(1, 8):
            found = plus(found, pattern(desk.folds, k, random.normal(size=len(desk.folds)) * size))
        return found

    return _climbed(desk, start, queries, (mixture() for _ in range(queries)))


def _climbed(desk: Attacked, start: Outputs, queries: int, tries: Iterable[Outputs]) -> Outputs:
    found = start
    desk.ask(start)
    for tried in itertools.islice(tries, queries - 1):
        new_best, _ = desk.ask(plus(found, tried))
        if new_best:
            found = plus(found, tried)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--problem", default="two_tanks_sim")
    options = parser.parse_args()
    problem = load_problem(options.problem)
    folds, metric = make_folds(problem.train, problem.protocol), problem.protocol.metric
    start = baseline(problem, folds)
    value = Attacked(folds, metric).true(start).value
    print(
        f"{problem.name}, linear model, V = {value:.4f}; {options.queries} queries, best of sizes"
    )
    rows: dict[str, int | None] = {"exact": None}
    rows |= {f"{digits} digits": digits for digits in (4, 3, 2)}
    print(
        "| told | regression | climbing | together | mixtures | gain |\n|---|---|---|---|---|---|"
    )
    for name, digits in rows.items():
        after = []
        for attack in (regression, climbing, together, mixtures):
            ends = [
                attack(Attacked(folds, metric, digits), start, options.queries, size)
                for size in AMPLITUDES
            ]
            after.append(min(Attacked(folds, metric).true(end).value for end in ends))
        gain = 1.0 - min(*after, value) / value
        print(f"| {name} | {' | '.join(f'{v:.4f}' for v in after)} | {gain:.1%} |", flush=True)


if __name__ == "__main__":
    main()
