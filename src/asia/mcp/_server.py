"""The server: tools, resources and the prompt, over one desk."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Callable
from typing import Any

from mcp.server import MCPServer
from mcp.server.mcpserver.exceptions import ResourceError, ResourceNotFoundError
from mcp_types import ToolAnnotations

import asia
from asia._text import markdown_line, one_line, say
from asia.drive import RunDesk
from asia.errors import AsiaError, UserError
from asia.ledger import describe_result, journal, results_table
from asia.mcp._opened import Opened
from asia.mcp._texts import INSTRUCTIONS, problem_page, search_prompt
from asia.mcp._tools import Tools

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
