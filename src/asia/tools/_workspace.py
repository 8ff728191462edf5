"""Workspace of `tools.py`: the problem as the evaluator reads it, and splits of its records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from asia._files import read_text
from asia._nearest import suggestion
from asia.candidate import Context
from asia.errors import UserError
from asia.evaluation import derive_seed, search_context
from asia.problem.load import Problem, load_problem
from asia.protocol import Fold, FoldRule, Group, ProtocolRule, make_folds
from asia.tools._local import LocalFold, evaluate


@dataclass(frozen=True)
class WorkspaceTools:
    """The tools of one workspace."""

    folder: Path
    """The workspace."""
    seed: int
    """Seed of its search."""

    @cached_property
    def problem(self) -> Problem:
        """problem.toml of the folder, with the training records of `data/`."""
        return load_problem(self.folder)

    @property
    def rule(self) -> ProtocolRule:
        """Rule by which V is computed."""
        return self.problem.protocol

    @property
    def context(self) -> Context:
        """Context of a candidate, except for the seed of its fold."""
        return search_context(self.problem, derive_seed(self.seed, "search"))

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """Those that V is computed on."""
        return make_folds(self.problem.train, self.rule)

    def blocks(self, count: int, gap: int = 0) -> tuple[Fold, ...]:
        """Folds of your own: each record in `count` blocks, of which each is held out once; the
        `gap` samples next to it train nothing."""
        return self._split(FoldRule("contiguous", count, gap=gap or None))

    def hold_out(self, names: Sequence[str]) -> tuple[Fold, ...]:
        """Return one fold of your own: these records are held out, all others train."""
        records = [t.name for t in self.problem.train]
        for name in names:
            if name not in records:
                raise UserError(
                    f"there is no record '{name}'{suggestion(name, records)} (they are "
                    f"{', '.join(records)})"
                )
        rest = tuple(name for name in records if name not in names)
        if not rest:
            raise UserError("all records are held out: leave one or more to train on")
        groups = Group("held out", tuple(names)), Group("rest", rest)
        return self._split(FoldRule("leave_one_group_out", 2, groups))[:1]

    def evaluate(
        self, path: Path | str = "candidate.py", folds: Sequence[Fold] | None = None
    ) -> tuple[LocalFold, ...]:
        """The candidate in that file, fitted and scored on these folds; None for those of V."""
        source = read_text(self.folder / path, "name a candidate, as Python source")
        chosen = self.folds if folds is None else folds
        limit = self.problem.budget.fit_seconds
        return evaluate(source, chosen, self.context, self.rule, limit)

    def _split(self, folds: FoldRule) -> tuple[Fold, ...]:
        return make_folds(self.problem.train, replace(self.rule, folds=folds))
