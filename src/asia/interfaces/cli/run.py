"""asia run: search."""

from __future__ import annotations

import sys
from contextlib import closing
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.interfaces.cli.driver import agent_driver, named_agent, refuse_for_others, relay_driver
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    PREFIX,
    CommandOptions,
    EngineOptions,
    Json,
    LlmOptions,
    ModelOptions,
    ProblemName,
    Profile,
    Runs,
    SearchOptions,
    given,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from asia._timer import ActivityTimer
    from asia.interfaces.cli.driver import Driver
    from asia.judge.executors import Executor
    from asia.ledger.view import SearchView
    from asia.problem.problem import Problem
    from asia.search.run import Prepared


NOTHING_FOUND = 3
BRIEF_HELP = frozenset(
    {"problem", "agent", "experiments", "seed", "hours", "name", "runs", "parallel", "executor"}
    | {"isolation", "model", "json"}
)

Space = Annotated[
    str | None,
    typer.Option(help="Search space of random: library (default), or paper."),
]
Sinks = Annotated[
    list[str] | None,
    typer.Option(help="Send the events to an installed sink, or module:Name; repeatable."),
]


def run(
    *,
    problem: ProblemName = "two_tanks_sim",
    agent: Annotated[
        str,
        typer.Option(
            help="Agent: expert, random, bayes, llm, command:NAME, or your module:Class; a relay: "
            " expert*8,bayes."
        ),
    ] = "expert",
    space: Space = None,
    options: SearchOptions,
    engine: EngineOptions,
    sink: Sinks = None,
    runs: Runs = DEFAULT_RUNS,
    profile: Profile = False,
    json: Json = False,
    models: ModelOptions,
    llm: LlmOptions,
    command: CommandOptions,
) -> None:
    """Search for a model. Repeat the command to resume; more --experiments extends the search.

    Exit code 3: the search is finished and no candidate has a score.
    """
    from asia._timer import Activity, ActivityTimer
    from asia.search.run import prepare

    options.check()
    driver = _driver(agent, space, models, llm, command)
    watch = ActivityTimer()
    with watch.activity(Activity.PREPARE):
        loaded = _problem(problem, options, driver)
        ready = prepare(
            loaded,
            driver.name,
            seed=options.seed,
            runs=runs,
            name=options.name,
            isolation=options.level,
            isolation_strict=options.isolation_strict,
            agent_settings=driver.settings,
            legs=driver.legs,
            parallel=engine.parallel,
            stop_folds=engine.stop_folds,
            device=engine.device,
        )
        runs_on = engine.chosen()
    view = _search(driver, loaded, ready, sink or (), watch, runs_on, profile=profile, json=json)
    if view.best is None:
        raise typer.Exit(NOTHING_FOUND)


def _problem(name: str, options: SearchOptions, driver: Driver) -> Problem:
    """Load the problem with the settings of the command line, and the budget of a relay."""
    from asia.problem.load import load_problem
    from asia.search.run import with_relay_budget

    loaded = options.applied(load_problem(name))
    return loaded if options.experiments is not None else with_relay_budget(loaded, driver.legs)


def _search(
    driver: Driver,
    problem: Problem,
    ready: Prepared,
    sink: Sequence[str],
    watch: ActivityTimer,
    runs_on: Executor,
    *,
    profile: bool,
    json: bool,
) -> SearchView:
    """Search, then draw the report. watch: time of the preparation."""
    from asia._diagnostic import diagnostic
    from asia._timer import Activity
    from asia.interfaces.cli.display import make_display
    from asia.report import write_report
    from asia.search.sinks import open_sinks

    sinks = open_sinks(ready.directory, sink)
    with closing(make_display(problem, ready, json=json)) as display, sinks:
        for line in driver.words:
            say(line, file=sys.stderr)
        view = driver.search(
            ready,
            sinks.after_event(display.on_event),
            sinks.after_start(display.on_start),
            runs_on,
        )
        failed: list[str] = []
        pictures: tuple[Path, ...] = ()
        with watch.activity(Activity.PICTURES), diagnostic("pictures", failed):
            pictures = write_report(ready.directory, failed=failed)
        display.finish(view, pictures, failed)
        if profile:
            display.profile(ready.directory, watch.only(Activity.PREPARE, Activity.PICTURES))
    return view


def _driver(
    agent: str, space: str | None, models: ModelOptions, llm: LlmOptions, command: CommandOptions
) -> Driver:
    """Make the driver of the agent. Raises UserError for an option of another agent."""
    from asia.agents.registry import asked_relay

    plans = asked_relay(agent)
    agents = [plan.agent for plan in plans] or [agent]
    for owners, options in (
        (("llm",), given(llm, leave_out=("base_url", "api_key_env"))),
        (("command",), given(command, leave_out=("stuck_minutes",))),
        (("llm", "command"), given(models)),
        (("random",), {"space": space}),
    ):
        refuse_for_others(agents, owners=owners, **options)
    drivers = [_one_driver(each, space, models, llm, command) for each in agents]
    return relay_driver(plans, drivers) if plans else drivers[0]


def _one_driver(
    agent: str, space: str | None, models: ModelOptions, llm: LlmOptions, command: CommandOptions
) -> Driver:
    if agent.startswith(PREFIX):
        return command.driver(agent, models)
    if agent == "llm":
        return agent_driver(llm.agent(models))
    return agent_driver(named_agent(agent, space if agent == "random" else None))
