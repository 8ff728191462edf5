"""Progress lines of a comparison."""

from __future__ import annotations

import json as jsonlib
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from asia._text import say

if TYPE_CHECKING:
    from asia.bench import ComparisonPlan, PlannedRun
    from asia.ledger import Event, SearchView


@dataclass
class Lines:
    """One line per experiment; with `json`, JSON lines on stdout and these lines on stderr."""

    json: bool
    start: float = field(default_factory=time.monotonic)

    def head(self, plan: ComparisonPlan) -> None:
        """Print the plan."""
        searches = plan.searches
        total = sum(run.problem.budget.experiments for run in searches)
        self.print(
            f"{plan.word} {plan.problem.name}: {len(searches)} searches, {total} experiments, "
            f"seeds {', '.join(str(s) for s in plan.seeds)}, early stopping "
            f"{', '.join(plan.settings)}"
        )

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Print the name of the search."""
        self.print(f"\n[{number}/{total}] {run.name}")

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print the line of an evaluated experiment."""
        from asia.cli._output.words import experiment_line
        from asia.ledger import Evaluated

        if isinstance(event, Evaluated):
            self.print(experiment_line(view.experiment(event.experiment), view))

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """Print the best V of the search."""
        from asia.ledger import error_value

        best = view.best
        value = best.score.value if best is not None and best.score is not None else None
        words = "no candidate has a score" if value is None else f"best V {error_value(value)}"
        self.print(f"    {words} after {len(view.finished)} experiments")
        if self.json:
            found = {
                "event": "run",
                "run": run.name,
                "arm": run.arm.name,
                "early_stopping": run.setting,
                "seed": run.seed,
                "experiments": len(view.finished),
                "V": value,
            }
            say(jsonlib.dumps(found, allow_nan=False), flush=True)

    def print(self, text: str) -> None:
        """Print a text line."""
        say(text, file=sys.stderr if self.json else sys.stdout, flush=True)
