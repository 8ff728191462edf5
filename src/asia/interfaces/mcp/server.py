"""MCP server: tools, resources, prompt."""

from __future__ import annotations

import inspect
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Annotated, Any, TypeVar

import anyio
import anyio.to_thread
from mcp.server import MCPServer
from mcp.server.mcpserver import Context
from mcp.server.mcpserver.exceptions import ResourceError, ResourceNotFoundError, ToolError
from mcp_types import ToolAnnotations
from pydantic import Field

import asia
from asia._text import markdown_line, one_line, say
from asia.agents.view import Proposal
from asia.errors import AsiaError, UserError
from asia.interfaces.mcp.answers import (
    INSTRUCTIONS,
    DryRunAnswer,
    Opened,
    ProgressAnswer,
    ResultsAnswer,
    SourceAnswer,
    SubmissionAnswer,
    WaitAnswer,
    best_of,
    experiment_answer,
    problem_page,
    search_prompt,
    source_answer,
    submission_answer,
)
from asia.interfaces.workspace.server import RunDesk, Submission, dry_run_lines
from asia.ledger.exports import journal, results_table
from asia.ledger.text import describe_result

# The tools. Each docstring is what an agent reads of it.


LONGEST_WAIT = 45.0
_POLL = 0.25
_PROGRESS_SECONDS = 3.0
_NOTES = 5
_NOTE = 1000

T = TypeVar("T")

TicketName = Annotated[str, Field(description="The ticket that asia_submit gave.")]


class Tools:
    """Methods that become tools. Every one asks the desk in a thread, so that several calls and a
    cancelled one do not wait for each other."""

    def __init__(self, desk: RunDesk, page: str, fit_seconds: float) -> None:
        self._desk, self._page, self._fit_seconds = desk, page, fit_seconds

    async def problem(self) -> str:
        """Task, description, signals, how V is computed, the contract of candidate.py and the
        model library. Read this first."""
        return self._page

    async def submit(
        self,
        code: Annotated[str, Field(description="The whole candidate.py, at most 64 KB.")],
        hypothesis: Annotated[str, Field(description="What you change and why it should help.")],
        expected: Annotated[
            str,
            Field(description="What you expect of V and of the residuals, in words or a number."),
        ],
        family: Annotated[str, Field(description="Kind of model, a word or two.")] = "",
        parent: Annotated[
            int | None, Field(description="Experiment that it was made from.")
        ] = None,
    ) -> SubmissionAnswer:
        """Hand in a candidate; costs one experiment. Returns a ticket at once: call asia_wait with
        it. The same source again returns the ticket it has; a source that does not parse, or has no
        fit, is refused and costs nothing."""
        proposal = Proposal(code, family, "", hypothesis, expected, parent)
        submission = await ask(self._desk.submit, proposal)
        return submission_answer(submission, _after_submit(submission))

    async def dry_run(
        self, code: Annotated[str, Field(description="The whole candidate.py, at most 64 KB.")]
    ) -> DryRunAnswer:
        """Fit and simulate a candidate on a short cut of training records: contract, shapes and
        speed. No experiment, no score; reason and advice say what fails. lines: what to read."""
        found = await ask(self._desk.dry_run, code)
        return DryRunAnswer(found.reason, found.advice, found.detail, tuple(dry_run_lines(found)))

    async def wait(
        self,
        ctx: Context[Any, Any],
        ticket: TicketName,
        timeout_s: Annotated[float, Field(ge=0, le=LONGEST_WAIT)] = LONGEST_WAIT,
    ) -> WaitAnswer:
        """Wait for a submission, at most 45 s, with progress. state: queued, running or done; call
        it again until it is done. V is null for a candidate that failed: see reason and advice."""
        start = time.monotonic()
        submission = await self._known(ticket)
        if submission.state != "done":
            await ask(self._desk.wake)
        reported = -_PROGRESS_SECONDS
        while submission.state in ("queued", "running"):
            waited = time.monotonic() - start
            if waited >= timeout_s:
                break
            if waited - reported >= _PROGRESS_SECONDS:
                reported = waited
                now = await ask(self._desk.progress)
                text = _progress_text(submission, begun=now.experiments > 0)
                await ctx.report_progress(round(waited, 1), timeout_s, text)
            await anyio.sleep(min(_POLL, timeout_s - waited))
            submission = await ask(self._desk.submission, ticket)
        if submission.state == "unknown":
            raise ToolError(f"submission {ticket} was withdrawn: asia_submit another")
        return await self._waited(submission)

    async def status(self) -> ProgressAnswer:
        """State of the search: experiments spent and left, best V, V of reference models, notes of
        the user.
        """
        now = await ask(self._desk.progress)
        return ProgressAnswer(
            run=now.run,
            problem=now.problem,
            state=now.state,
            metric=now.v_name,
            experiments=now.experiments,
            budget=now.budget,
            remaining=now.remaining,
            best=best_of(now),
            rungs=now.rungs,
            notes=_notes(now.notes),
            next=_next_step(now.state, now.remaining),
        )

    async def results(
        self, last: Annotated[int, Field(ge=1, le=200, description="How many.")] = 20
    ) -> ResultsAnswer:
        """The last experiments with V, folds, status and reason, oldest first."""
        found = await ask(self._desk.results)
        now = await ask(self._desk.progress)
        return ResultsAnswer(
            total=len(found),
            best=best_of(now),
            results=tuple(experiment_answer(r) for r in found[-last:]),
        )

    async def show(
        self, experiment: Annotated[int, Field(description="Its number, from 1.")]
    ) -> SourceAnswer:
        """One experiment: hypothesis, expectation, result, training residuals a fold, source.
        whiteness, input_correlation, curvature: correlation of the residual with its own past, past
        inputs, squared output. top_, bottom_, start_error: RMS residual at the highest and lowest
        outputs and in the first 5 % of a record, relative to that of all.
        """
        return await ask(lambda: source_answer(self._desk.run(), experiment))

    async def best(self) -> SourceAnswer:
        """The best experiment so far, as asia_show gives it."""
        now = await ask(self._desk.progress)
        if now.best is None:
            raise ToolError(
                "no experiment has a score yet: asia_wait for a submission, or see asia_results"
            )
        return await self.show(now.best)

    async def cancel(self, ticket: TicketName) -> SubmissionAnswer:
        """Take back a submission that is still queued; it costs no experiment then. One that is
        being evaluated is not interrupted: it ends by itself, within the time limit of a fit."""
        submission = await self._known(ticket)
        if submission.state == "running":
            raise ToolError(
                f"submission {ticket} is being evaluated as experiment "
                f"{submission.experiment} and is not interrupted: it ends by itself, a fit within "
                f"{self._fit_seconds:g} s a fold"
            )
        return submission_answer(await ask(self._desk.withdraw, ticket), "asia_submit")

    async def _known(self, name: str) -> Submission:
        submission = await ask(self._desk.submission, name)
        if submission.state == "unknown":
            raise ToolError(
                f"no submission has the ticket '{one_line(name, 60)}': it was withdrawn, or "
                "belongs to another run; asia_results lists what was evaluated"
            )
        return submission

    async def _waited(self, submission: Submission) -> WaitAnswer:
        now = await ask(self._desk.progress)
        done = await ask(self._desk.results) if submission.state == "done" else ()
        found = [experiment_answer(r) for r in done if r.experiment == submission.experiment]
        evidence = await ask(self._desk.evidence, found[0].experiment) if found else None
        return WaitAnswer(
            **asdict(submission),
            evidence=evidence.lines if evidence else (),
            result=found[0] if found else None,
            best=best_of(now),
            remaining=now.remaining,
            notes=_notes(now.notes),
            next=_next_step(now.state, now.remaining) if found else "asia_wait with this ticket",
        )


async def ask(function: Callable[..., T], *arguments: object) -> T:
    """Call the desk in a thread; what it complains of is for the agent to read."""
    call = partial(function, *arguments)
    try:
        return await anyio.to_thread.run_sync(call, abandon_on_cancel=True)
    except AsiaError as error:
        raise ToolError(str(error)) from None
    except OSError as error:
        raise ToolError(f"{error.strerror or error}: {error.filename or 'a file'}") from None


def _progress_text(submission: Submission, *, begun: bool) -> str:
    if submission.state == "running":
        return f"experiment {submission.experiment} is being evaluated"
    if not begun:
        return "the search evaluates the reference models, then the baseline"
    return f"queued, {submission.ahead} before it" if submission.ahead else "queued, it is next"


def _after_submit(submission: Submission) -> str:
    if not submission.repeated:
        return "asia_wait with this ticket"
    which = "a submission that waits"
    if submission.experiment is not None:
        which = f"experiment {submission.experiment}"
    return (
        f"not judged again: comments apart, this is the source of {which}, and costs nothing; "
        "asia_wait with this ticket gives its result"
    )


def _notes(notes: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(one_line(note, _NOTE) for note in notes[-_NOTES:])


def _next_step(state: str, remaining: int) -> str:
    if state == "unsealed":
        return "the sealed test was opened: the search is over; report the result"
    if remaining == 0:
        return "the budget is spent: report the result, asia_best has it"
    return "asia_submit the next candidate"


# The server: tools, resources and the prompt, over one desk.


# More than the longest hypothesis; a candidate's error is cut.
_LINE = 2200

_READS = ToolAnnotations(read_only_hint=True, destructive_hint=False, open_world_hint=False)
_ADDS = ToolAnnotations(
    read_only_hint=False, destructive_hint=False, idempotent_hint=True, open_world_hint=False
)
_REMOVES = ToolAnnotations(
    read_only_hint=False, destructive_hint=True, idempotent_hint=True, open_world_hint=False
)


def make_server(opened: Opened) -> MCPServer[Any]:
    """A server over this run; its search is started in the background, so that the client need not
    wait for it."""
    problem = opened.problem
    server: MCPServer[Any] = MCPServer(
        "asia", instructions=INSTRUCTIONS, version=asia.__version__, log_level="WARNING"
    )
    page = problem_page(problem)
    _add_tools(server, Tools(opened.desk, page, problem.budget.fit_seconds))
    _add_resources(server, opened.desk, page)

    @server.prompt(name="asia_search")
    def start(focus: str = "") -> str:  # pyright: ignore[reportUnusedFunction]
        """Search for a model of this problem. focus: anything special to try."""
        return search_prompt(problem, focus)

    threading.Thread(target=_warm, args=(opened.desk,), daemon=True).start()
    return server


def _warm(desk: RunDesk) -> None:
    try:
        desk.run()
        desk.wake()
    except UserError as error:
        # The next tool call raises the same error and reports it to the agent.
        say(f"asia: {error}", file=sys.stderr)


def _add_tools(server: MCPServer[Any], tools: Tools) -> None:
    rows: list[tuple[Callable[..., Any], ToolAnnotations]] = [
        (tools.problem, _READS),
        (tools.dry_run, _READS),
        (tools.submit, _ADDS),
        (tools.wait, _READS),
        (tools.status, _READS),
        (tools.results, _READS),
        (tools.show, _READS),
        (tools.best, _READS),
        (tools.cancel, _REMOVES),
    ]
    for function, hints in rows:
        server.add_tool(
            function,
            name=f"asia_{function.__name__}",
            description=" ".join((inspect.getdoc(function) or "").split()),
            annotations=hints,
        )


def _add_resources(server: MCPServer[Any], desk: RunDesk, page: str) -> None:
    @server.resource("asia://problem", name="problem", mime_type="text/markdown")
    def problem() -> str:  # pyright: ignore[reportUnusedFunction]
        """Description, signals, protocol, contract, library."""
        return page

    @server.resource("asia://ledger", name="ledger", mime_type="text/markdown")
    def ledger() -> str:  # pyright: ignore[reportUnusedFunction]
        """Table of results, and the search journal."""
        return _readable(lambda: _ledger(desk))

    @server.resource("asia://experiments/{n}", name="experiment", mime_type="text/markdown")
    def experiment(n: str) -> str:  # pyright: ignore[reportUnusedFunction]
        """Hypothesis, outcome and source of one experiment."""
        return _readable(lambda: _experiment(desk, n))


def _readable(text: Callable[[], str]) -> str:
    try:
        return text()
    except AsiaError as error:
        raise ResourceError(str(error)) from None


def _ledger(desk: RunDesk) -> str:
    view = desk.run().view
    lines = "\n".join(one_line(line, _LINE) for line in journal(view).splitlines())
    return f"```tsv\n{results_table(view)}```\n\n{lines}\n"


def _experiment(desk: RunDesk, number: str) -> str:
    run = desk.run()
    if not number.isdecimal() or int(number) not in {e.number for e in run.view.experiments}:
        raise ResourceNotFoundError(
            f"no experiment {number!r}: there are 1 to {len(run.view.experiments)}"
        )
    e = run.view.experiment(int(number))
    source = run.store.text(e.proposed.source)
    # A source may hold the fence itself.
    fence = "`" * 3
    while fence in source:
        fence += "`"
    return (
        f"# Experiment {e.number}: {markdown_line(e.proposed.title)}\n\n"
        f"- **Hypothesis:** {markdown_line(e.proposed.hypothesis)}\n"
        f"- **Expected:** {markdown_line(e.proposed.expected)}\n"
        f"- **Result:** {markdown_line(one_line(describe_result(e, run.view), _LINE))}\n\n"
        f"{fence}python\n{source}\n{fence}\n"
    )
