"""asia agent: a workspace, its submissions, an MCP server, a check of a language model."""

from __future__ import annotations

import json as jsonlib
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._files import read_text
from asia._text import say, say_lines
from asia._timer import duration
from asia.errors import Reason, UserError
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    GuardRecords,
    JailOptions,
    Json,
    LlmOptions,
    ModelOptions,
    ProblemName,
    Runs,
    SearchOptions,
    access_settings,
    given,
    jail_words,
)
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.chain import write_whole
from asia.ledger.events import Evaluated, Event
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.presentation.experiments import describe_result
from asia.presentation.table import error_value

if TYPE_CHECKING:
    from asia.interfaces.workspace.server import (
        ExperimentResult,
        RunDesk,
        SearchProgress,
        SocketDesk,
        Submission,
    )

NO_SCORE = 3
CHECK_PROBLEM = "two_tanks_sim"
BRIEF_HELP = frozenset(
    {"problem", "folder", "experiments", "seed", "hours", "name", "runs", "isolation", "jail"}
    | {"network", "start", "guard"}
)


# asia agent workspace: a folder in which a user or a coding agent writes candidates.


def workspace(
    *,
    problem: ProblemName,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to make.")],
    options: SearchOptions,
    jail: Annotated[
        str | None,
        typer.Option(
            metavar="CMD", help="Run this program in a jail that shows only the folder, and wait."
        ),
    ] = None,
    opened: JailOptions,
    start: Annotated[
        bool,
        typer.Option(
            "--start/--no-start", help="Evaluate the baseline now, or at the first asia try."
        ),
    ] = True,
    guard: GuardRecords = None,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Make a folder with the training data, the task and the baseline. Edit the candidate there and
    submit it with asia try. The evaluator is another process, and the ledger is in another folder.

    Repeat the command to update the texts or to increase the budget; your candidate is kept.
    With --jail the exit code is that of the program.
    """
    from asia.interfaces.coding_agents.session import check_jail, run_jailed
    from asia.interfaces.workspace.process import (
        guard_words,
        prepare_request,
        start_search,
        with_guard,
    )
    from asia.interfaces.workspace.program import Confinement
    from asia.interfaces.workspace.server import wait
    from asia.interfaces.workspace.workspace import make_workspace

    request = options.request(
        str(Path(problem).resolve()) if Path(problem).is_dir() else problem, "workspace"
    )
    access, program = None, shlex.split(jail or "")
    if jail is not None:
        access = opened.access()
        settings = {"command": jail, "jail": "namespace", **access_settings(access)}
        request = replace(request, settings=settings)
    else:
        for name in given(opened):
            raise UserError(
                f"--{name.replace('_', '-')} belongs to --jail CMD: add it or leave it out"
            )
    request = with_guard(request, guard, runs, options.name)
    prepared = prepare_request(request, runs, options.name)
    if access is not None:
        check_jail(program, access, prepared.directory, prepared.problem)
    confinement = Confinement.OPEN if access is None else access.confinement
    made = make_workspace(folder, prepared, request, confinement)
    sealed = prepared.started.test_digest
    files = sorted(p.name + "/" * p.is_dir() for p in made.folder.iterdir() if p.name[0] != ".")
    say(f"wrote    {made.folder}: {', '.join(files)}")
    say(f"run      {prepared.directory}, {prepared.started.experiments} experiments")
    say(
        f"judge    isolation {prepared.started.isolation_words}; "
        f"test {'sealed, ' + sealed[:8] if sealed else 'none'}"
    )
    say(f"guard    {guard_words(prepared.problem, request)}")
    if access is not None:
        say(f"{program[0]:<8} {jail_words(access)}", flush=True)
        start_search(prepared.directory)
        code = run_jailed(made, program, access)
        say(f"{program[0]} ended with exit code {code}", file=sys.stderr)
        if code:
            raise typer.Exit(code)
        return
    desk = made.desk() if start else None
    if desk is not None and not desk.progress().experiments:
        # Print a line for each reference model and the baseline. The search survives an interrupt.
        waiting = Waiting(desk, lambda line: say(line, flush=True))
        try:
            wait(desk, "experiment-1", float("inf"), waiting.look)
        except KeyboardInterrupt:
            say("the baseline is still evaluated, in the background", file=sys.stderr)
            raise
        say(finished_line(desk.results()[0], desk.progress()))
        made.renew_views()
    say(f'next     cd {folder}; read PROGRAM.md; edit candidate.py; asia try -m "why it helps"')


# asia agent try: submit the candidate of a workspace.


def try_(
    message: Annotated[
        str, typer.Option("--message", "-m", help="Hypothesis: what changed, and why it helps.")
    ] = "",
    expect: Annotated[
        str, typer.Option(help="Expected V and residuals, as text or a number.")
    ] = "",
    parent: Annotated[
        int | None, typer.Option(help="Experiment that the candidate was derived from.")
    ] = None,
    family: Annotated[
        str,
        typer.Option(
            help="Kind of model, in a word or two; default: the families that the source imports."
        ),
    ] = "",
    folder: Annotated[
        Path, typer.Option("--dir", help="A workspace, or a folder inside one.")
    ] = Path(),
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Only fit and simulate on some training samples; uses no experiment."
        ),
    ] = False,
    plot: Annotated[
        bool, typer.Option("--plot", help="Also draw the simulation and its residuals into plots/.")
    ] = False,
    json: Json = False,
) -> None:
    """Evaluate candidate.py of this workspace, and wait for the result.

    Exit code 3: the candidate has no score. It is evaluated even if you interrupt this command.
    """
    from asia.agents.view import Proposal
    from asia.interfaces.workspace.server import to_json, wait
    from asia.interfaces.workspace.workspace import CANDIDATE, Workspace, scored_locally

    if dry_run and plot:
        raise UserError("--plot needs a score, and --dry-run gives none: leave one of them out")
    if not dry_run and not message.strip():
        raise UserError(
            'a candidate needs a hypothesis: asia try -m "what you changed, and why it should help"'
        )
    place = Workspace.find(folder)
    source = read_text(place.folder / CANDIDATE, "write the candidate there, as Python source")
    desk = place.desk()
    if dry_run:
        tried = desk.dry_run(source)
        if json:
            say(jsonlib.dumps(to_json(tried), allow_nan=False))
        else:
            for line in tried.lines:
                say(line)
        if tried.reason is not None:
            raise typer.Exit(NO_SCORE)
        return
    many = scored_locally(place.folder)
    remark = f"scored in the workspace on the folds of V so far: {many} candidates" * (many > 1)
    proposal = Proposal(source, family, message, message, expect, parent, remark=remark)
    submission = desk.submit(proposal)
    repeated = submission.repeated
    if submission.state not in ("done", "unknown"):
        # One stream, so that the lines keep their order where the output is captured.
        stream = sys.stderr if json else sys.stdout
        waiting = Waiting(desk, lambda line: say(line, file=stream, flush=True))
        while submission.state not in ("done", "unknown"):
            submission = wait(desk, submission.ticket, 3600.0, waiting.look)
    result = next((r for r in desk.results() if r.experiment == submission.experiment), None)
    if result is None:
        raise UserError("the submission was withdrawn before it was evaluated")
    progress, evidence = desk.progress(), desk.evidence(result.experiment)
    place.renew_views()
    pictures: tuple[str, ...] = ()
    if plot and result.V is not None:
        try:
            pictures = place.draw(result.experiment, desk.simulated(result.experiment))
        except UserError as error:
            say(f"no picture: {error}", file=sys.stderr)
    if json:
        answer = {
            **to_json(result),
            "best": to_json(progress.best),
            "remaining": progress.remaining,
            "notes": list(progress.notes),
            "repeated": repeated,
            "pictures": list(pictures),
            "evidence": to_json(evidence),
        }
        say(jsonlib.dumps(answer, allow_nan=False))
    else:
        if repeated:
            say(
                f"not evaluated again: the source equals that of #{result.experiment:02d}, apart "
                "from comments. No experiment was used:"
            )
        for line in result_lines(result, progress, evidence.lines):
            say(line)
        if remark:
            say(f"    {remark}; the lowest of many is optimistic")
        for name in pictures:
            say(f"    picture {name}")
    if result.V is None:
        raise typer.Exit(NO_SCORE)


def result_lines(
    result: ExperimentResult, progress: SearchProgress, evidence: Sequence[str] = ()
) -> list[str]:
    """Return the result of an experiment on one screen, with `evidence` in the middle."""
    head = f"#{result.experiment:02d} {result.status:<7} "
    if result.V is not None:
        folds = ", ".join(error_value(v) for v in result.folds)
        parts = f" (folds {folds})" if folds else ""
        lines = [f"{head}{progress.metric} = {error_value(result.V)}{parts}"]
    else:
        lines = [f"{head}no score: {result.advice}"]
        if result.detail:
            # These reasons are found by ASIA; the others come with words of the candidate.
            found = (Reason.SUSPECT, Reason.RESTART, Reason.SOURCE_SIZE, Reason.NOT_REPRODUCIBLE)
            words = "found" if result.reason in found else "the candidate's own words"
            lines.append(f"    {words}: {result.detail}")
    lines += [f"    {line}" for line in evidence]
    if result.training is not None:
        lines += [f"    {line}" for line in training_lines(result.training)]
    if result.duplicate_of is not None:
        lines.append(f"    the same source as #{result.duplicate_of:02d}; its outcome stands")
    best = "none yet"
    if progress.best is not None:
        best = f"#{progress.best.experiment:02d} {error_value(progress.best.V)}"
    lines.append(f"    best {best}, {progress.remaining} of {progress.budget} experiments left")
    return lines + [f"note from the user: {note}" for note in progress.notes[-3:]]


def training_lines(found: Diagnostics) -> tuple[str, ...]:
    """Return the figures of the worst output, of a fold or of the worst fold."""
    return (
        f"training side, worst fold and output: error {found.train_error:.3g} as in V, mean "
        f"residual {found.bias:.2g} s.d.",
        f"  correlation of the residual with its own past {found.whiteness:.2f}, with past inputs "
        f"{found.input_correlation:.2f}, with the squared output {found.curvature:.2f}",
        f"  RMS residual over that of all samples: output in its top tenth {found.top_error:.2f}, "
        f"bottom tenth {found.bottom_error:.2f}; first 5 % of a record {found.start_error:.2f}",
    )


class Waiting:
    """Print each change once: finished references and experiments, and the state of the submission.
    Repeat an unchanged state every minute."""

    def __init__(self, desk: RunDesk | SocketDesk, say: Callable[[str], None]) -> None:
        self._desk, self._say = desk, say
        now = desk.progress()
        self._references = set(now.references if now.experiments else ())
        self._finished = now.experiments
        self._state = ""
        self._since = self._said = time.monotonic()

    def look(self, submission: Submission) -> None:
        """Print the changes since the last call."""
        now = self._desk.progress()
        for name, value in now.references.items():
            if name not in self._references:
                self._references.add(name)
                self._say(f"reference {name}: {now.metric} {_equals(value)}")
        if now.experiments > self._finished:
            for result in self._desk.results()[self._finished :]:
                if result.experiment != submission.experiment:
                    self._say(finished_line(result, now))
            self._finished = now.experiments
        state, clock = submission_line(submission, now), time.monotonic()
        if state != self._state:
            self._state, self._since, self._said = state, clock, clock
            if state:
                self._say(state)
        elif state and clock - self._said >= 60.0:
            self._said = clock
            self._say(f"{state}, for {duration(clock - self._since)}")


def finished_line(result: ExperimentResult, now: SearchProgress) -> str:
    """`#01 keep    V = 0.7984 in 12s: baseline`"""
    head = f"#{result.experiment:02d} {result.status:<7} {now.metric}"
    return f"{head} {_equals(result.V)} in {duration(result.seconds)}: {result.title}"


def _equals(value: float | None) -> str:
    return "none" if value is None else f"= {error_value(value)}"


def submission_line(submission: Submission, now: SearchProgress) -> str:
    """Return what a submission waits for; "" if it does not."""
    queued, ahead = submission.state == "queued", submission.ahead
    if not queued and submission.state != "running":
        return ""
    running = now.running if queued else submission.experiment
    if running is not None:
        baseline = ", the baseline," if running == 1 else ""
        behind = f"; {ahead} before yours" if ahead else "; yours is next"
        return f"#{running:02d}{baseline} is being evaluated{behind if queued else ''}"
    if now.experiments == 0:
        return "the search evaluates the reference models, then the baseline"
    return f"queued, {ahead} before it" if ahead else "queued, it is next"


# asia agent mcp: a search as a server of the Model Context Protocol; asia agent config: the
# configuration of its clients.


def mcp(
    *,
    problem: ProblemName,
    options: SearchOptions,
    http: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Streamable HTTP on this machine, not stdio."),
    ] = None,
    token_env: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Environment variable with the bearer token of --http."),
    ] = None,
    guard: GuardRecords = None,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Serve a search to a coding agent: it submits candidates, the search evaluates them.

    Coding agents start this command themselves: asia agent config prints their configuration. The
    search is a separate process and outlives this one; asia status and asia steer work on it.
    """
    from asia.interfaces.mcp import AGENT, open_search, require_sdk
    from asia.interfaces.workspace.process import guard_words, with_guard

    require_sdk()
    request = with_guard(options.request(problem, AGENT), guard, runs, options.name)
    if token_env is not None and http is None:
        raise UserError("--token-env belongs to --http: stdio uses no token")
    opened = open_search(request, runs, options.name)
    # The standard output is the protocol's.
    say(f"guard    {guard_words(opened.problem, request)}", file=sys.stderr)
    if http is not None:
        from asia.interfaces.mcp.http import serve

        serve(opened, http, token_env)
    else:
        # A thread that waits for a line on stdin would keep a process that leaves by itself.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        from asia.interfaces.mcp.server import make_server

        make_server(opened).run()


def mcp_config(
    *,
    client: Annotated[str, typer.Argument(metavar="CLIENT", help="claude, codex or gemini.")],
    problem: ProblemName,
    options: SearchOptions,
    guard: GuardRecords = None,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print the configuration with which a coding agent starts asia agent mcp.

    The configuration goes to stdout, the name of its file and notes to stderr.
    """
    from asia.interfaces.mcp.config import CLIENTS, client_configuration
    from asia.problem.load import load_problem

    if client not in CLIENTS:
        raise UserError(f"no client '{client}'; there is: {', '.join(CLIENTS)}")
    options.check()
    load_problem(problem)
    path = Path(problem)
    own = path.is_file() or (path / "problem.toml").is_file()
    name = str(path.resolve()) if own else problem
    chosen = [] if guard is None else ["--guard" if guard else "--no-guard"]
    words = [name, *options.words(), *chosen, "--runs", str(runs.resolve())]
    # Clients start a server with little of their own environment.
    data = os.environ.get("ASIA_DATA_DIR")
    environment = {} if data is None else {"ASIA_DATA_DIR": str(Path(data).resolve())}
    found = client_configuration(client, words, environment)
    say_lines(found.text, end="")
    for note in found.notes:
        say(f"# {note}", file=sys.stderr)


# asia agent check: test a language model on a simulated problem.


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
    from asia.agents.llm.reply import llm_report
    from asia.agents.llm.settings import first_model
    from asia.problem.load import load_problem
    from asia.search.run import prepare, search
    from asia.search.steering import Steering

    if llm.base_url is None and llm.local is None and models.model is None:
        raise UserError(
            "asia agent check needs a server or a model: give --base-url, --model or both, or "
            "--local"
        )
    if models.model is None and llm.local is None:
        models = replace(models, model=first_model(llm.base_url or "", llm.api_key_env))
    agent = llm.agent(models)
    # A new name, because the server may have changed since the last check.
    words = re.sub(r"\W+", "-", agent.settings.model).strip("-") or "model"
    problem = load_problem(CHECK_PROBLEM)
    budget = replace(problem.budget, experiments=steps + 1, fit_seconds=30.0)
    ready = prepare(
        replace(problem, budget=budget),
        agent.name,
        seed=0,
        runs=runs,
        name=f"llm-check-{words}-{time.strftime('%Y%m%d-%H%M%S')}",
        agent_settings=agent.recorded(),
    )
    start = time.monotonic()

    def on_event(event: Event, view: SearchView) -> None:
        """Print each result, and stop the search when the time is over."""
        if isinstance(event, Evaluated):
            done = view.experiment(event.experiment)
            text = f"#{done.number:02d} {done.proposed.title}: {describe_result(done, view)}"
            say(text, file=sys.stderr)
            if time.monotonic() > start + 60.0 * minutes:
                Steering(ready.directory).stop()

    search(ready, agent, on_event, lambda view: None)
    report = llm_report(open_run(ready.directory))
    table = {"verdict": report.verdict, **asdict(report)}
    path = ready.directory / "llm-check.json"
    write_whole(path, (jsonlib.dumps(table, indent=1) + "\n").encode())
    if json:
        say(jsonlib.dumps(table))
    else:
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
        say(f"time                 {duration(time.monotonic() - start)}")
        for title, lines in (("wrong answer", report.wrong), ("failure", report.failures)):
            for line in lines:
                say(f"{title:<21}{line}")
        say(f"kept in {path}")
    if report.verdict == "not able":
        raise typer.Exit(NO_SCORE)
