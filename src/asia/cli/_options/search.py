"""Options of a search: budget, name, isolation."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from asia.drive import SearchRequest
    from asia.problem.load import Problem
    from asia.sandbox import Isolation


@dataclass(frozen=True)
class SearchOptions:
    """Options of every command that starts a search."""

    experiments: Annotated[
        int | None, typer.Option(min=1, help="Candidates to evaluate, the baseline included.")
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0
    hours: Annotated[
        float | None, typer.Option(help="Start no experiment after this many hours of evaluation.")
    ] = None
    retests: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Repeat fits required before accepting a new best; 0: one fit decides. Default: "
            "the problem's.",
        ),
    ] = None
    name: Annotated[
        str | None, typer.Option(help="Name of the run; default PROBLEM-AGENT-sSEED.")
    ] = None
    early_stopping: Annotated[
        str | None,
        typer.Option(help="inner, or validation (V is then not leak-free); default the problem's."),
    ] = None
    isolation: Annotated[
        str | None,
        typer.Option(help="Isolation level instead of the strongest: landlock or process."),
    ] = None
    isolation_strict: Annotated[
        bool,
        typer.Option(
            "--isolation-strict",
            help="Fit the folds one at a time: slower, but workers cannot communicate.",
        ),
    ] = False

    @property
    def level(self) -> Isolation | None:
        """The requested level. Raises UserError for an unknown one."""
        from asia.errors import UserError
        from asia.sandbox import Isolation

        levels = [level.value for level in Isolation]
        if self.isolation is not None and self.isolation not in levels:
            raise UserError(f"--isolation {self.isolation}: expected one of {', '.join(levels)}")
        return Isolation(self.isolation) if self.isolation else None

    def check(self) -> None:
        """Raise UserError for an invalid name or an unknown level. A number would be read as an
        experiment, and a path would leave the directory of the runs."""
        from asia.errors import UserError

        name = self.name
        if name is not None and (not re.fullmatch(r"\w[\w.+-]*", name) or name.isdecimal()):
            raise UserError(
                f"--name '{name}': expected letters, digits and . _ + - that begin with a letter "
                "or digit and are not a number alone"
            )
        _ = self.level

    def applied(self, problem: Problem) -> Problem:
        """Return the problem with these options in place of its own."""
        from asia.search import with_early_stopping

        own = problem.budget
        budget = replace(
            own,
            experiments=self.experiments or own.experiments,
            hours=self.hours if self.hours is not None else own.hours,
            retests=self.retests if self.retests is not None else own.retests,
        )
        problem = replace(problem, budget=budget)
        if self.early_stopping is None:
            return problem
        return with_early_stopping(problem, self.early_stopping)

    def request(self, problem: str, agent: str) -> SearchRequest:
        """Return the request for a search by `agent`. Raises UserError as `check` does."""
        from asia.drive import SearchRequest

        self.check()
        return SearchRequest(
            problem=problem,
            agent=agent,
            seed=self.seed,
            experiments=self.experiments,
            hours=self.hours,
            early_stopping=self.early_stopping,
            isolation=self.isolation,
            isolation_strict=self.isolation_strict,
            retests=self.retests,
        )

    def words(self) -> list[str]:
        """Return the command line of these options."""
        pairs = (
            ("--experiments", self.experiments),
            ("--seed", self.seed or None),
            ("--hours", self.hours),
            ("--retests", self.retests),
            ("--name", self.name),
            ("--early-stopping", self.early_stopping),
            ("--isolation", self.isolation),
        )
        words = [w for option, value in pairs if value is not None for w in (option, str(value))]
        return [*words, *(["--isolation-strict"] if self.isolation_strict else [])]
