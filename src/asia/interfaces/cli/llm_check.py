"""asia agent check: test a language model on a simulated problem."""

from __future__ import annotations

import json as jsonlib
import re
import sys
import time
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, LlmOptions, ModelOptions, Runs

if TYPE_CHECKING:
    from asia.agents.llm.reply import LlmReport
    from asia.ledger.events import Event
    from asia.ledger.view import SearchView
    from asia.search.loop import OnEvent
    from asia.search.run import Prepared

PROBLEM = "two_tanks_sim"
REPORT = "llm-check.json"
_FIT_SECONDS = 30.0
_NOT_ABLE = 3


def llm_check(
    *,
    steps: Annotated[int, typer.Option(min=1, help="Candidates to ask for.")] = 4,
    minutes: Annotated[
        float, typer.Option(help="Ask for no more candidates after this many minutes.")
    ] = 2.0,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
    models: ModelOptions,
    llm: LlmOptions,
) -> None:
    """Let a language model search on a simulated problem for two minutes. Report whether its
    answers have the required form, how many were repaired, and its tokens per step.

    Default model: the first one that the server lists. The report is kept as llm-check.json in the
    run. Exit code 3: not able.
    """
    from asia.agents.llm.models import first_model
    from asia.agents.llm.reply import llm_report
    from asia.errors import UserError
    from asia.ledger.chain import write_whole
    from asia.ledger.run import open_run
    from asia.problem.load import load_problem
    from asia.search.run import prepare, search

    if llm.base_url is None and models.model is None:
        raise UserError(
            "asia agent check needs a server or a model: give --base-url, --model or both"
        )
    if models.model is None:
        models = replace(models, model=first_model(llm.base_url or "", llm.api_key_env))
    agent = llm.agent(models)
    problem = load_problem(PROBLEM)
    budget = replace(problem.budget, experiments=steps + 1, fit_seconds=_FIT_SECONDS)
    ready = prepare(
        replace(problem, budget=budget),
        agent.name,
        seed=0,
        runs=runs,
        name=_name(models.model or ""),
        agent_settings=agent.recorded(),
    )
    start = time.monotonic()
    search(ready, agent, _within(ready, start + 60.0 * minutes), lambda view: None)
    report = llm_report(open_run(ready.directory))
    path = ready.directory / REPORT
    write_whole(path, (jsonlib.dumps(_table(report), indent=1) + "\n").encode())
    if json:
        say(jsonlib.dumps(_table(report)))
    else:
        _print(report, time.monotonic() - start)
        say(f"kept in {path}")
    if report.verdict == "not able":
        raise typer.Exit(_NOT_ABLE)


def _name(model: str) -> str:
    """Return a new run name, because the server may have changed since the last check."""
    words = re.sub(r"\W+", "-", model).strip("-") or "model"
    return f"llm-check-{words}-{time.strftime('%Y%m%d-%H%M%S')}"


def _within(ready: Prepared, end: float) -> OnEvent:
    """Print each result, and stop the search when the time is over."""
    from asia.ledger.events import Evaluated
    from asia.ledger.text import describe_result
    from asia.search.steering import Steering

    def on_event(event: Event, view: SearchView) -> None:
        if isinstance(event, Evaluated):
            done = view.experiment(event.experiment)
            say(
                f"#{done.number:02d} {done.proposed.title}: {describe_result(done, view)}",
                file=sys.stderr,
            )
            if time.monotonic() > end:
                Steering(ready.directory).stop()

    return on_event


def _table(report: LlmReport) -> dict[str, object]:
    return {"verdict": report.verdict, **asdict(report)}


def _print(report: LlmReport, seconds: float) -> None:
    from asia._timer import duration

    best = "no score" if report.best is None else f"V {report.best:.4g}"
    baseline = "no score" if report.baseline is None else f"V {report.baseline:.4g}"
    say(f"{report.model} at {report.base_url or 'the default server'}: {report.verdict}")
    say(
        f"form of the answer   {report.at_once} of {report.steps} at once, {report.repaired} "
        f"repaired, {report.without_candidate} without a candidate"
    )
    say(f"candidates           {report.scored} of {report.steps} with a score")
    say(f"best                 {best}; the baseline has {baseline}")
    say(
        f"tokens               {report.tokens_a_step:.0f} per step; longest request "
        f"{report.prompt_tokens}, longest reply {report.reply_tokens}"
    )
    say(f"time                 {duration(seconds)}")
    for title, lines in (("wrong answer", report.wrong), ("failure", report.failures)):
        for line in lines:
            say(f"{title:<21}{line}")
