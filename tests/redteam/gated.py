"""Searches with candidates whose V means nothing, with the gate and without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.run import model_to_use
from asia.ledger.view import Experiment, SearchView
from asia.problem.folds import whole
from asia.problem.load import load_problem
from asia.problem.seal import open_guard
from asia.search.guard import error_on, simulated
from asia.search.run import make_evaluator
from tests.redteam.interfaces import Interface, search_with
from tests.redteam.problem import small_problem


@dataclass(frozen=True)
class Played:
    """One search, and the errors of its experiments on the guard records."""

    names: tuple[str, ...]
    """The candidates in the order of their experiments; the first is the honest one."""
    view: SearchView
    on_guard: Mapping[int, float | None]
    """By experiment; None for a failure."""
    gate: bool

    def experiment(self, name: str) -> Experiment:
        """The experiment of a candidate."""
        return self.view.experiment(1 + self.names.index(name))

    @property
    def statuses(self) -> dict[str, str]:
        """By candidate."""
        return {
            name: e.result.status
            for name, e in zip(self.names, self.view.finished, strict=True)
            if e.result
        }

    @property
    def values(self) -> dict[str, float]:
        """V by candidate, of those with a score."""
        pairs = zip(self.names, self.view.finished, strict=True)
        return {name: e.score.value for name, e in pairs if e.score is not None}

    @property
    def handed_over(self) -> str:
        """The best experiment, the model to use, and the members of its stack."""
        view, use = self.view, model_to_use(self.view)
        stack = view.refitted.stack if view.refitted is not None else None
        text = f"{use.model if use else 'nothing'} of " + (
            f"#{view.best.number:02d}" if view.best is not None else "nothing"
        )
        if stack is not None:
            members = ", ".join(f"#{m.experiment:02d}" for m in stack.members)
            text += f" (stack {members}, V {stack.value:.3g})"
        return text

    @property
    def members(self) -> set[int]:
        """The experiments whose models a user may get."""
        stack = self.view.refitted.stack if self.view.refitted is not None else None
        best = {self.view.best.number} if self.view.best is not None else set[int]()
        return best | ({m.experiment for m in stack.members} if stack is not None else set())


def play(
    candidates: Mapping[str, str],
    folder: Path,
    *,
    gate: bool = True,
    interface: Interface = Interface.LOCAL,
    isolation: Isolation | None = None,
) -> Played:
    """Search on the problem "counted" with the honest candidate and these, one after the other.

    Args:
        gate: False for a search that takes V for evidence
    """
    folder.mkdir()
    given = (list(candidates.values()), interface, folder, small_problem("counted"))
    with patch("asia.search.run.can_read_records", lambda names: gate):
        view = search_with(*given, isolation=isolation)
    names = ("honest", *candidates)[: len(view.finished)]
    return Played(names, view, _on_guard(folder, view, isolation), gate)


def _on_guard(
    folder: Path, view: SearchView, isolation: Isolation | None
) -> dict[int, float | None]:
    problem = load_problem(folder / "small")
    evaluator = make_evaluator(problem, view, isolation=isolation)
    blocks = tuple(whole(open_guard(problem), problem.protocol))
    (run,) = (path for path in (folder / "runs").iterdir() if (path / "ledger.jsonl").exists())
    store = Store(run / "artifacts")
    found: dict[int, float | None] = {}
    for e in view.finished:
        if e.score is None:
            continue
        models = [store.get(fold.model) for fold in e.folds]
        y_hat = simulated(evaluator, store.text(e.proposed.source), models, blocks)
        outcome = error_on(evaluator, y_hat, blocks)
        found[e.number] = outcome.value if isinstance(outcome, Score) else None
    return found


def play_both(
    candidates: Mapping[str, str], folder: Path, isolation: Isolation | None = None
) -> tuple[Played, Played]:
    """With the gate, and without it from the highest V to the lowest."""
    gated = play(candidates, folder / "gated", isolation=isolation)
    order = sorted(candidates, key=lambda name: -gated.values.get(name, 0.0))
    again = {name: candidates[name] for name in order}
    return gated, play(again, folder / "open", gate=False, isolation=isolation)


HEAD = ("candidate", "V", "error on guard", "status", "without the gate")


def rows(gated: Played, free: Played) -> list[tuple[str, ...]]:
    """V, error on the guard records and status of each candidate, and at the end the models that
    the search hands over."""
    found: list[tuple[str, ...]] = []
    for name, status in gated.statuses.items():
        e = gated.experiment(name)
        figures = (e.score.value if e.score else None, gated.on_guard.get(e.number))
        words = ("-" if value is None else f"{value:.3g}" for value in figures)
        found.append((name, *words, status, free.statuses.get(name, "-")))
    return [*found, ("handed over", "", "", gated.handed_over, free.handed_over)]
