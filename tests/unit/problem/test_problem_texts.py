"""Notes from the literature and strategies: optional texts, kept in the lock."""

from collections.abc import Callable
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_differences, lock_text
from asia.problem.problem import Seal

Write = Callable[..., Path]
SEAL = Seal("0" * 64)


def test_texts_are_read_and_locked(write_problem: Write, minimal: str, tmp_path: Path) -> None:
    directory = write_problem('notes = "n.txt"\nstrategies = "s.txt"\n' + minimal)
    (directory / "n.txt").write_text("from a paper\n")
    (directory / "s.txt").write_text("try this\n")
    problem = load_problem(directory)
    assert (problem.notes, problem.strategies) == ("from a paper\n", "try this\n")
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, SEAL), encoding="utf-8")
    again = load_lock(path)
    assert (again.notes, again.strategies) == (problem.notes, problem.strategies)
    (directory / "s.txt").write_text("try that\n")
    changed = lock_differences(load_problem(directory), SEAL, path)
    assert [str(d) for d in changed] == ["strategies changed"]
    path.write_text(path.read_text("utf-8").replace("from a paper", "from a blog"))
    with pytest.raises(UserError, match="the notes changed"):
        load_lock(path)


def test_without_texts_the_lock_does_not_name_them(write_problem: Write, minimal: str) -> None:
    text = lock_text(load_problem(write_problem(minimal)), SEAL)
    assert "notes" not in text
    assert "strategies" not in text


def test_a_missing_text_is_named(write_problem: Write, minimal: str) -> None:
    with pytest.raises(UserError, match=r"no such file.*gone\.txt"):
        load_problem(write_problem('notes = "gone.txt"\n' + minimal))
