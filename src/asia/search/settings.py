"""Settings of a search in place of those of its problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, get_args

from annotated_types import Ge

from asia.errors import UserError
from asia.problem.protocol import EarlyStopping

if TYPE_CHECKING:
    from asia.problem.problem import Problem


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings of a search; None for the problem's own. The command line shows the texts."""

    experiments: Annotated[int | None, Ge(1), "Candidates to evaluate, the baseline included."] = (
        None
    )
    seed: Annotated[int, Ge(0), "Seed of the search."] = 0
    hours: Annotated[float | None, "Start no experiment after this many hours of evaluation."] = (
        None
    )
    retests: Annotated[
        int | None,
        Ge(0),
        "Repeat fits required before accepting a new best; 0: one fit decides. Default: the "
        "problem's.",
    ] = None
    early_stopping: Annotated[
        str | None, "inner, or validation (V is then not leak-free); default the problem's."
    ] = None
    isolation: Annotated[
        str | None, "Isolation level instead of the strongest: landlock or process."
    ] = None
    isolation_strict: Annotated[
        bool, "Fit the folds one at a time: slower, but workers cannot communicate."
    ] = False

    def applied(self, problem: Problem) -> Problem:
        """Return the problem with these settings in place of its own. Raises UserError for an
        unknown kind of early stopping."""
        named = ("experiments", "hours", "retests")
        own = {name: value for name in named if (value := getattr(self, name)) is not None}
        problem = replace(problem, budget=replace(problem.budget, **own))
        setting = self.early_stopping
        if setting is None:
            return problem
        if problem.control is not None and setting != "inner":
            text = 'controllers are designed without scores: keep --early-stopping "inner"'
            raise UserError(text)
        for known in get_args(EarlyStopping):
            if setting == known:
                return replace(problem, protocol=replace(problem.protocol, early_stopping=known))
        raise UserError(
            f"early stopping '{setting}': expected {' or '.join(get_args(EarlyStopping))}; "
            "choose one, or leave it out for the problem's own"
        )
