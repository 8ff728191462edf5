"""A relay against each of its agents alone, at equal budget and paired by seed.

    python benchmarks/searches/relay.py --out DIR [--jobs N] [--seeds 5] [--experiments 10]
        [--first expert --second bayes] [--problems two_tanks_sim,wiener,cascaded_tanks]
        [--isolation process]

A problem is a built-in one or a kind of synthetic system, drawn anew with each seed. The first
agent of the relay has half of the experiments, the baseline among them. The same command goes on
with what is in DIR, and finishes nothing twice. The seeds come in turn, so that what there is after
an interrupt is a comparison already: DIR/relay.md has the tables of the finished searches.

Nothing here opens a test.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from asia.agents import Agent, make_agent
from asia.agents.relay import RelayAgent, legs_of, make_runner
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from asia.search.run import prepare, search
from harness import (
    Brisk,
    number,
    option_parser,
    run_all,
    synthetic_problem,
    table,
    with_experiments,
    words,
)
from systems import KINDS, make_system

# A fit may take the problem's own time; the agents plan for less, which makes their fits short.
PLANNED_SECONDS = 20.0


@dataclass(frozen=True)
class Task:
    """One search."""

    problem: str
    """Name of the problem."""
    arm: str
    """Searching agents: an agent by name, or a relay such as `expert*5+bayes`."""
    seed: int
    """Seed of the search, and of a synthetic system."""
    experiments: int
    """Its budget."""
    isolation: str | None
    """The level of isolation; None for the strongest."""
    out: Path
    """Folder of problems and runs."""

    @property
    def run(self) -> str:
        """Name of the run."""
        arm = self.arm.replace("*", "")
        return f"{self.problem}-{arm}-s{self.seed}-n{self.experiments}"


@dataclass(frozen=True)
class Found:
    """Result of a search."""

    task: Task
    """The search."""
    value: float | None
    """Best V; None when no candidate has a score."""
    seconds: float
    """Seconds of evaluation."""


def main() -> None:
    """Run the searches that are not there yet, and print the tables."""
    options = _options()
    tasks = _tasks(options)
    found: list[Found] = []
    for one in run_all(run_task, tasks, options.jobs):
        found.append(one)
        (options.out / "relay.md").write_text(tables(found, len(tasks)))
    print(tables(found, len(tasks)))


def _options() -> argparse.Namespace:
    parser = option_parser(__doc__)
    problems = ["two_tanks_sim", "wiener", "cascaded_tanks"]
    parser.add_argument("--problems", default=problems, type=words(), metavar="A,B")
    parser.add_argument("--first", default="expert", help="first agent of the relay")
    parser.add_argument("--second", default="bayes", help="second agent of the relay")
    parser.add_argument("--seeds", type=int, default=5, help="how many, from 0 on")
    parser.add_argument("--experiments", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1, help="searches at a time")
    parser.add_argument("--isolation", choices=[level.value for level in Isolation])
    parser.add_argument("--out", type=Path, required=True, help="keep everything here, and resume")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    return options


def _tasks(options: argparse.Namespace) -> list[Task]:
    """The relay first: without it a seed says nothing."""
    relay = f"{options.first}*{options.experiments // 2}+{options.second}"
    return [
        Task(problem, arm, seed, options.experiments, options.isolation, options.out)
        for seed in range(options.seeds)
        for problem in options.problems
        for arm in (relay, options.first, options.second)
    ]


def run_task(task: Task) -> Found:
    """The search from where it is, or its result."""
    start, problem = time.monotonic(), _problem(task)
    agent = _agent(task.arm)
    ready = prepare(
        problem,
        agent.name,
        seed=task.seed,
        runs=task.out / "runs",
        name=task.run,
        isolation=Isolation(task.isolation) if task.isolation else None,
        legs=legs_of(agent),
    )
    view = search(ready, agent, lambda *_: None, lambda _: None)
    best = open_run(ready.directory).view.best
    value = best.score.value if best is not None and best.score is not None else None
    wall = time.monotonic() - start
    print(
        f"{task.run}  V {number(value)} by #{best.number if best else 0}, evaluations "
        f"{view.seconds:.0f} s, wall {wall:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    return Found(task, value, view.seconds)


def _problem(task: Task) -> Problem:
    if task.problem in KINDS:
        place = task.out / "problems" / f"{task.problem}-{task.seed}"
        return synthetic_problem(
            make_system(KINDS[task.problem], task.seed), place, task.experiments
        )
    return with_experiments(load_problem(task.problem), task.experiments)


def _agent(arm: str) -> Agent:
    agent = make_agent(arm)
    if not isinstance(agent, RelayAgent):
        return Brisk(agent, PLANNED_SECONDS)
    return RelayAgent(
        [make_runner(Brisk(r.agent, PLANNED_SECONDS), r.leg.experiments) for r in agent.runners],
    )


def tables(found: Sequence[Found], total: int) -> str:
    """Median V by problem and arm, then the relay paired with each arm alone."""
    problems = list(dict.fromkeys(f.task.problem for f in sorted(found, key=_place)))
    arms = sorted({f.task.arm for f in found}, key=lambda arm: ("*" not in arm, arm))
    values = {(f.task.problem, f.task.arm, f.task.seed): f.value for f in found}
    lines = [
        f"{len(found)} of {total} searches are finished.",
        "",
    ]
    cells = [
        [problem, *(_median([f for f in found if (f.task.problem, f.task.arm) == (problem, arm)])
                    for arm in arms)]
        for problem in problems
    ]  # fmt: skip
    lines.append(table(["problem", *(f"median V, {arm} (seeds)" for arm in arms)], cells))
    heads = "problem", "relay against", "seeds", "better", "same", "worse"
    rows: list[list[str]] = []
    relay, *alone = arms
    for other in alone:
        every: list[float] = []
        for problem in problems:
            ratios = _ratios(values, problem, relay, other)
            every += ratios
            rows.append(_pair_row(problem, other, ratios))
        rows.append(_pair_row("all", other, every))
    lines += ["", table([*heads, "median V ratio", "V ratios"], rows)]
    seconds = [f.seconds for f in found]
    lines += [
        "",
        "V ratio: V of the relay over V of the agent alone with the same seed, below 1 where the "
        "relay is better. All have the same number of experiments, not the same time: evaluations "
        f"took {median(seconds) if seconds else 0:.0f} s a search in the median. With five seeds a "
        "problem no difference is significant at 5 %.",
    ]
    return "\n".join(lines) + "\n"


def _place(found: Found) -> tuple[int, str]:
    return found.task.seed, found.task.problem


def _ratios(
    values: dict[tuple[str, str, int], float | None], problem: str, relay: str, other: str
) -> list[float]:
    """Ratios for the seeds for which both have a score."""
    seeds = sorted({seed for name, _, seed in values if name == problem})
    pairs = [(values.get((problem, relay, s)), values.get((problem, other, s))) for s in seeds]
    return [a / b for a, b in pairs if a is not None and b is not None]


def _pair_row(problem: str, other: str, ratios: Sequence[float]) -> list[str]:
    if not ratios:
        return [problem, other, "0", *[""] * 5]
    better, same = sum(r < 1 for r in ratios), sum(r == 1 for r in ratios)
    each = ", ".join(f"{r:.2f}" for r in ratios)
    counts = len(ratios), better, same, len(ratios) - better - same
    return [problem, other, *map(str, counts), f"{median(ratios):.3f}", each]


def _median(found: Sequence[Found]) -> str:
    known = [f.value for f in found if f.value is not None]
    return f"{number(median(known))} ({len(known)})" if known else "-"


if __name__ == "__main__":
    main()
