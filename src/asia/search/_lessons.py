"""From finished runs to lessons."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from asia.agents.lessons import Lesson, learn
from asia.errors import UserError
from asia.ledger import Run, open_run, verify
from asia.problem.load import load_lock
from asia.search._agent_view import agent_view, problem_facts
from asia.search._run import LOCK

_DIGITS = 16


@dataclass(frozen=True)
class RunLessons:
    """What the runs of a directory taught."""

    lessons: tuple[Lesson, ...]
    """Of all runs that could be learned from."""
    learned: tuple[str, ...]
    """Their names."""
    left_out: tuple[tuple[str, str], ...]
    """Names of the others, and why."""


def learn_from_run(directory: Path) -> tuple[Lesson, ...]:
    """The lessons of a finished run, from V of its experiments; its test is not read.

    Raises UserError when it does not verify, is not finished, or has a V that is not leak-free, and
    when its problem is no longer what it was.
    """
    verify(directory)
    run = open_run(directory)
    if not run.view.complete:
        raise UserError("the search is not finished")
    if run.view.started.early_stopping != "inner":
        raise UserError(f"its {run.view.v_name} is not leak-free")
    facts = problem_facts(load_lock(directory / LOCK))
    return learn(agent_view(facts, run.view, run.store), _digest(run))


def learn_from_runs(runs: Path) -> RunLessons:
    """The lessons of all runs in a directory, those that cannot be learned from left out."""
    lessons: list[Lesson] = []
    learned: list[str] = []
    left_out: list[tuple[str, str]] = []
    for directory in _directories(runs):
        try:
            lessons += learn_from_run(directory)
        except UserError as error:
            left_out.append((directory.name, str(error)))
        else:
            learned.append(directory.name)
    return RunLessons(tuple(lessons), tuple(learned), tuple(left_out))


def _directories(runs: Path) -> Sequence[Path]:
    return sorted(ledger.parent for ledger in runs.glob("*/ledger.jsonl"))


def _digest(run: Run) -> str:
    """Stays the same when the search is extended or its directory renamed."""
    started = run.view.started
    text = f"{started.run}:{started.lock_digest}:{started.agent}:{started.seed}"
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]
