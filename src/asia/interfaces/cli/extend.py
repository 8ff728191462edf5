"""asia extend: go on with one more record."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia._timer import Activity, ActivityTimer
from asia.errors import UserError
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    CommandOptions,
    EngineOptions,
    Json,
    LlmOptions,
    ModelOptions,
    Runs,
    SearchOptions,
    run_directory,
)
from asia.interfaces.cli.run import Driver, make_driver, search_and_print
from asia.presentation.experiments import value_text

if TYPE_CHECKING:
    from asia.agents.view import Agent
    from asia.search.run import Prepared

# Candidates of the old search that are proposed first, and how much larger their V may be.
_LEADING, _FAR = 3, 4.0


def extend(
    *,
    run: Annotated[str, typer.Argument(metavar="RUN", help="Path or name of the finished run.")],
    record: Annotated[
        Path, typer.Argument(metavar="RECORD", help="File with the new record, such as new.csv.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the extended problem; default PROBLEM-RECORD here."),
    ] = None,
    agent: Annotated[
        str, typer.Option(help="Agent that goes on after the leading candidates, as for asia run.")
    ] = "expert",
    options: SearchOptions,
    engine: EngineOptions,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Add a record to a copy of a run's problem, say how well the old model does on it, and start a
    search whose first proposals are the leading candidates of the run. The run stays as it was.

    Repeat the command to resume. Exit code 3: no candidate has a score.
    """
    from asia.agents.leading import LeadingAgent, LeadingCandidate, leading_settings
    from asia.ledger.run import open_run
    from asia.presentation.table import error_value
    from asia.search.extension import error_on_record, extended_problem, leading_experiments
    from asia.search.pending import check_steps_ahead

    options.check()
    timer = ActivityTimer()
    with timer.activity(Activity.PREPARE):
        old = open_run(run_directory(runs, run, named=True))
        # The baseline comes before them, and the agent needs one after them.
        budget = options.experiments or old.view.budget
        if budget < 3:
            raise UserError(f"a budget of {budget} experiments: give --experiments 3 or more")
        candidates = [
            LeadingCandidate(
                one.proposed.family, one.proposed.title, old.store.text(one.source),
                f"{old.name} #{one.number:02d}, V {error_value(one.score.value)}",
            )
            for one in leading_experiments(old.view, min(_LEADING, budget - 2), _FAR)
            if one.score is not None
        ]  # fmt: skip
        following = make_driver(agent, ModelOptions(), LlmOptions(), CommandOptions())
        folder = out or Path(f"{old.view.started.problem}-{record.stem}")
        problem, notes = extended_problem(old, record, folder)
        use, outcome = error_on_record(old, record, options.level)

    def make_agent(ready: Prepared) -> Agent:
        then = following.make(ready)
        check_steps_ahead(ready.started.parallel, then)
        return LeadingAgent(candidates, then)

    best = old.view.best
    assert best is not None
    assert best.score is not None
    stream = sys.stderr if json else sys.stdout
    say(
        f"before    the old model ({use} of #{best.number:02d}) has V={value_text(outcome)} on "
        f"{record.name} before any fit; in its search it had V={error_value(best.score.value)}",
        file=stream,
    )
    for note in notes:
        say(f"note      {note}", file=stream)
    say(f"problem   {folder}", file=stream)
    search_and_print(
        options.applied(problem),
        Driver(
            LeadingAgent.name,
            make_agent,
            leading_settings(candidates, following.name, following.settings),
            following.notes,
        ),
        options, engine, runs, json=json, timer=timer,
    )  # fmt: skip
