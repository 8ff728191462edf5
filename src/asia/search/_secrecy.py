"""Check that hidden data lie outside every folder that candidates and agents can read."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from asia.errors import UserError
from asia.problem.load import Problem, kept_places, record_places
from asia.sandbox import LEVELS, Isolation, shown_in


def check_run_is_hidden(problem: Problem, directory: Path, level: Isolation) -> None:
    """Raises UserError when the run directory, a record or the key of the test lies in a folder
    that every worker can read. A level that confines nothing hides nothing, and nothing is checked
    there."""
    if not LEVELS[level].confined:
        return
    for path in (directory, *record_places(problem), *kept_places(problem)):
        check_hidden_from_workers(path)


def check_hidden_from_workers(path: Path) -> None:
    """Raises UserError when `path` lies in a folder that every worker can read."""
    folder = shown_in(path)
    if folder is not None:
        raise UserError(
            f"{path} lies in {folder}, which every candidate can read, because it holds the "
            "interpreter, its libraries or the package of a part: keep runs, data and keys "
            "elsewhere"
        )


def check_hidden_from_agent(shown: Iterable[Path], problem: Problem) -> None:
    """Raises UserError when a folder that an agent is to be shown holds the test data or their
    key."""
    hidden = [path.resolve() for path in kept_places(problem)]
    for path in shown:
        real = path.resolve()
        for place in hidden:
            if real == place or real in place.parents or place in real.parents:
                raise UserError(
                    f"{path} would show the agent {place}, which contains test data or "
                    "their key: give a smaller folder"
                )
