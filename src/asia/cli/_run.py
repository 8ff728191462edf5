"""asia run: search."""

from __future__ import annotations

import re
import sys
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli import _command_options as program
from asia.cli import _llm_options as llm
from asia.cli._driver import agent_driver, built_in, refuse_for_others
from asia.cli._options import (
    DEFAULT_RUNS,
    EarlyStopping,
    Experiments,
    Hours,
    IsolationLevel,
    Json,
    Name,
    ProblemName,
    Runs,
    Seed,
)

NOTHING_FOUND = 3

if TYPE_CHECKING:
    from asia.problem.load import Problem
    from asia.sandbox import Isolation


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("run")(run)


def run(
    problem: ProblemName = "two_tanks_sim",
    agent: Annotated[
        str, typer.Option(help="Who proposes: expert, random, bayes, llm or command:NAME.")
    ] = "expert",
    space: Annotated[
        str | None,
        typer.Option(help="What random draws from: library (default), or the paper's: paper."),
    ] = None,
    experiments: Experiments = None,
    seed: Seed = 0,
    hours: Hours = None,
    name: Name = None,
    early_stopping: EarlyStopping = None,
    isolation: IsolationLevel = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
    model: llm.Model = None,
    base_url: llm.BaseUrl = None,
    temperature: llm.Temperature = None,
    top_p: llm.TopP = None,
    llm_seed: llm.Seed = None,
    extra_body: llm.ExtraBody = None,
    api_key_env: llm.ApiKeyEnv = llm.KEY_VARIABLE,
    max_tokens: llm.MaxTokens = None,
    max_reply_tokens: llm.MaxReplyTokens = None,
    max_cost: llm.MaxCost = None,
    prices: llm.Prices = None,
    anonymous: llm.Anonymous = False,
    command: program.Command = None,
    agent_minutes: program.Minutes = None,
    stuck_minutes: program.StuckMinutes = 30.0,
    network: program.Network = False,
    agent_config: program.Configs = None,
    agent_mount: program.Mounts = None,
    pass_env: program.PassEnv = None,
) -> None:
    """Search for a model. The same command again resumes; more --experiments extends.

    Exit code 3: the search is finished and no candidate has a score.
    """
    from asia.cli._display import make_display
    from asia.problem.load import load_problem
    from asia.report import write_report
    from asia.search import prepare

    check_name(name)
    refuse_for_others(
        agent, temperature=temperature, top_p=top_p, llm_seed=llm_seed, extra_body=extra_body,
        max_reply_tokens=max_reply_tokens, prices=prices, anonymous=anonymous or None,
        owners=("llm",),
    )  # fmt: skip
    refuse_for_others(
        agent, command=command, agent_minutes=agent_minutes, network=network or None,
        agent_config=agent_config, agent_mount=agent_mount, pass_env=pass_env, owners=("command",),
    )  # fmt: skip
    refuse_for_others(
        agent, model=model, max_tokens=max_tokens, max_cost=max_cost, owners=("llm", "command")
    )
    refuse_for_others(agent, space=space, owners=("random",))
    if agent.startswith(program.PREFIX):
        driver = program.command_driver(
            agent, command, minutes=agent_minutes, stuck_minutes=stuck_minutes, tokens=max_tokens,
            cost=max_cost, network=network, configs=agent_config, mounts=agent_mount,
            pass_env=pass_env, model=model,
        )  # fmt: skip
    elif agent == "llm":
        driver = agent_driver(
            llm.llm_agent(
                model=model, base_url=base_url, temperature=temperature, top_p=top_p,
                seed=llm_seed, extra_body=extra_body, api_key_env=api_key_env,
                max_tokens=max_tokens, max_reply_tokens=max_reply_tokens, max_cost=max_cost,
                prices=prices, anonymous=anonymous,
            )
        )  # fmt: skip
    else:
        driver = agent_driver(built_in(agent, space))
    loaded = _with_rules(load_problem(problem), experiments, hours, early_stopping)
    ready = prepare(
        loaded,
        driver.name,
        seed=seed,
        runs=runs,
        name=name,
        isolation=check_level(isolation),
        agent_settings=driver.settings,
    )
    with closing(make_display(loaded, ready, json=json)) as display:
        for line in driver.words:
            print(line, file=sys.stderr)
        view = driver.search(ready, display.on_event, display.on_start)
        pictures = write_report(ready.directory)
        display.finish(view, pictures)
    if view.best is None:
        raise typer.Exit(NOTHING_FOUND)


def _with_rules(
    problem: Problem, experiments: int | None, hours: float | None, early_stopping: str | None
) -> Problem:
    """What the command line says goes before the problem's own."""
    from asia.search import with_early_stopping

    own = problem.budget
    budget = replace(
        own,
        experiments=experiments or own.experiments,
        hours=hours if hours is not None else own.hours,
    )
    problem = replace(problem, budget=budget)
    return with_early_stopping(problem, early_stopping) if early_stopping is not None else problem


def check_level(isolation: str | None) -> Isolation | None:
    """The level of this name. Raises UserError for an unknown one."""
    from asia.errors import UserError
    from asia.sandbox import Isolation

    levels = [level.value for level in Isolation]
    if isolation is not None and isolation not in levels:
        raise UserError(f"--isolation {isolation}: expected one of {', '.join(levels)}")
    return Isolation(isolation) if isolation else None


def check_name(name: str | None) -> None:
    """A number would be taken for an experiment, a path would leave the directory of the runs."""
    from asia.errors import UserError

    if name is not None and (not re.fullmatch(r"\w[\w.+-]*", name) or name.isdecimal()):
        raise UserError(
            f"--name '{name}': expected letters, digits and . _ + - that begin with a letter or "
            "digit and are not a number alone"
        )
