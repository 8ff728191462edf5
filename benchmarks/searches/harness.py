"""Parts shared by the scripts on searches: agents with short fits, problems, tables, a pool."""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from asia.agents import Agent, AgentView, Proposal
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from systems import System, write_problem

T = TypeVar("T")
R = TypeVar("R")


class Brisk:
    """An agent that plans for short fits. A fit may still take the problem's own time."""

    def __init__(self, agent: Agent, fit_seconds: float) -> None:
        self._agent, self._fit_seconds = agent, fit_seconds
        self.name = agent.name

    def propose(self, view: AgentView) -> Proposal | None:
        """Propose a candidate whose fit may take `fit_seconds`."""
        effort = replace(view.facts.budget, fit_seconds=self._fit_seconds)
        return self._agent.propose(replace(view, facts=replace(view.facts, budget=effort)))


def with_experiments(problem: Problem, experiments: int) -> Problem:
    """The problem at equal budget: nobody stops because nothing was found for a while."""
    budget = replace(problem.budget, experiments=experiments, patience=10 * experiments)
    return replace(problem, budget=budget)


def synthetic_problem(system: System, place: Path, experiments: int) -> Problem:
    """The problem of a synthetic system, written to `place` once."""
    if not (place / "problem.toml").is_file():
        write_problem(system, place, experiments)
    return with_experiments(load_problem(place), experiments)


def run_all(run: Callable[[T], R], tasks: Iterable[T], jobs: int) -> Iterator[R]:
    """Results of `run`, in processes, as they come."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        for future in as_completed([pool.submit(run, task) for task in tasks]):
            yield future.result()


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def number(value: float | None) -> str:
    """Four digits; `-` for None."""
    return "-" if value is None else f"{value:.4g}"


def option_parser(text: str | None) -> argparse.ArgumentParser:
    """A parser that describes itself by the first line of a docstring."""
    return argparse.ArgumentParser(description=(text or "").splitlines()[0])


def words(known: Iterable[str] | None = None) -> Callable[[str], list[str]]:
    """Parser of `A,B`; known: what may be named, None for anything."""

    def parse(text: str) -> list[str]:
        found = text.split(",")
        for word in found if known is not None else ():
            if word not in (known or ()):
                raise argparse.ArgumentTypeError(f"'{word}' is none of {', '.join(known or ())}")
        return found

    return parse
