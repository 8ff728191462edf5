"""Comparison of agents: a search for each agent and seed at equal budget, and the statistics."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from asia.agents.registry import NamedAgent
from asia.errors import UserError
from asia.judge.scoring.outcome import Score
from asia.ledger.run import open_run
from asia.ledger.view import Experiment, SearchView
from asia.problem.problem import Problem
from asia.search.loop import OnEvent
from asia.search.run import prepare, search

# No agent may stop because it found nothing for a while.
_PATIENCE = 100_000

Views = Mapping[tuple[str, int], SearchView]
"""Finished searches by agent and seed."""


@dataclass(frozen=True)
class ComparedSearch:
    """One search of a comparison."""

    problem: Problem
    agent: str
    make: Callable[[], NamedAgent]
    """Makes the agent."""
    seed: int

    @property
    def run(self) -> str:
        """Name of the run."""
        setting = self.problem.protocol.early_stopping
        return f"compare-{self.problem.name}-{self.agent}-{setting}-s{self.seed}"

    def search(self, runs: Path, on_event: OnEvent) -> SearchView:
        """Search in `runs`; continue a search that exists. Raises UserError as `prepare`."""
        made = self.make()
        ready = prepare(
            self.problem,
            made.agent.name,
            seed=self.seed,
            runs=runs,
            name=self.run,
            agent_settings=made.settings,
        )
        search(ready, made.agent, on_event, lambda view: None)
        return open_run(ready.directory).view


def plan_searches(
    problem: Problem,
    agents: Sequence[tuple[str, Callable[[], NamedAgent]]],
    seeds: Sequence[int],
    experiments: int | None = None,
) -> tuple[ComparedSearch, ...]:
    """Return a search for each seed and agent.

    Args:
        agents: name of each agent and the function that makes it.
        experiments: experiments of each search; None for the problem's number.

    Raises:
        UserError: an agent or a seed is missing or occurs twice.
    """
    for what, given in (("agent", [name for name, _ in agents]), ("seed", list(seeds))):
        if not given or len(set(given)) < len(given):
            text = ", ".join(str(one) for one in given) or "none"
            raise UserError(f"a comparison needs every {what} once, got: {text}")
    count = problem.budget.experiments if experiments is None else experiments
    budget = replace(problem.budget, experiments=count, patience=_PATIENCE)
    problem = replace(problem, budget=budget)
    return tuple(ComparedSearch(problem, *agent, seed) for seed in seeds for agent in agents)


@dataclass(frozen=True)
class Row:
    """V of one model or agent over the seeds."""

    model: str
    values: tuple[float, ...]
    """V of every run that has a score, in order of the seeds."""
    runs: int
    """Number of runs, with a score or without."""
    scores_seen: int = 0
    """Maximum number of times that a fit received its score on the held-out part in one run."""

    @property
    def median(self) -> float | None:
        """Median over the runs that have a score."""
        return statistics.median(self.values) if self.values else None


def row_of(model: str, experiments: Iterable[Experiment | None]) -> Row:
    """Summarise one experiment of each run; None for a run without it."""
    given = tuple(experiments)
    there = [e for e in given if e is not None]
    values = tuple(e.score.value for e in there if e.score is not None)
    seen = [e.result.validation_scores for e in there if e.result is not None]
    return Row(model, values, len(given), max(seen, default=0))


def rows_of(views: Views) -> tuple[Row, ...]:
    """Return V of the reference models, the baseline and the best experiment of each agent."""
    # References and baseline are the same in every run of a seed.
    of_seed: dict[int, SearchView] = {}
    for (_, seed), view in views.items():
        of_seed.setdefault(seed, view)
    first = list(of_seed.values())
    outcomes = [{r.name: r.outcome for r in view.references} for view in first]
    rows: list[Row] = []
    for name in dict.fromkeys(name for known in outcomes for name in known):
        found = [known.get(name) for known in outcomes]
        values = tuple(outcome.value for outcome in found if isinstance(outcome, Score))
        rows.append(Row(name, values, len(first)))
    baselines = [view.experiment(1) if view.experiments else None for view in first]
    rows.append(row_of("baseline of the problem", baselines))
    for agent in dict.fromkeys(agent for agent, _ in views):
        own = [view for (name, _), view in views.items() if name == agent]
        most = max(len(view.finished) for view in own)
        rows.append(row_of(f"{agent}, best of {most}", (view.best for view in own)))
    return tuple(rows)


@dataclass(frozen=True)
class Reached:
    """Number of experiments in which an agent reached the best V of another with the same seed."""

    agent: str
    other: str
    experiments: Mapping[int, int | None]
    """Number by seed; None where it was not reached or the other has no score."""


def experiments_to_reach(views: Views) -> tuple[Reached, ...]:
    """Count the experiments of the first agent to the best V of each other."""
    agent, *others = dict.fromkeys(agent for agent, _ in views)

    def count(seed: int, goal: float | None) -> int | None:
        tried = (e for e in views[agent, seed].finished if not e.unconfirmed)
        scored = ((e.number, e.score.value) for e in tried if e.score)
        return next((n for n, value in scored if goal is not None and value <= goal), None)

    return tuple(
        Reached(
            agent,
            other,
            {
                seed: count(seed, view.best_value)
                for (name, seed), view in views.items()
                if name == other and (agent, seed) in views
            },
        )
        for other in others
    )


@dataclass(frozen=True)
class Pair:
    """Two agents, paired by seed."""

    first: str
    second: str
    ratios: tuple[float, ...]
    """V of the first over V of the second, for each seed with which both have a score."""

    @property
    def p(self) -> float | None:
        """Exact two-sided p of Wilcoxon's signed-rank test on the logarithms of the ratios; None
        without a difference."""
        if all(ratio == 1 for ratio in self.ratios):
            return None
        test: Any = wilcoxon(np.log(self.ratios), method="exact")
        return float(test.pvalue)


def pairs_of(views: Views) -> tuple[Pair, ...]:
    """Pair each two agents; () for one agent."""
    best = {key: view.best_value for key, view in views.items()}
    seeds = sorted({seed for _, seed in views})
    found: list[Pair] = []
    for first, second in itertools.combinations(dict.fromkeys(agent for agent, _ in views), 2):
        both = [(best.get((first, s)), best.get((second, s))) for s in seeds]
        ratios = tuple(a / b for a, b in both if a is not None and b is not None)
        found.append(Pair(first, second, ratios))
    return tuple(found)
