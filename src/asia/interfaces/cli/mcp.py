"""asia agent mcp: a search as a server of the Model Context Protocol; asia agent config: the
configuration of its clients."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from asia._text import say, say_lines
from asia.interfaces.cli.options import DEFAULT_RUNS, ProblemName, Runs, SearchOptions

# Clients start a server with little of their own environment.
_HANDED_ON = ("ASIA_DATA_DIR",)


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
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Serve a search to a coding agent: it submits candidates, the search evaluates them.

    Coding agents start this command themselves: asia agent config prints their configuration. The
    search is a separate process and outlives this one; asia status and asia steer work on it.
    """
    from asia.errors import UserError
    from asia.interfaces.mcp import require_sdk, serve_http, serve_stdio
    from asia.interfaces.mcp.answers import AGENT, open_search

    require_sdk()
    request = options.request(problem, AGENT)
    if token_env is not None and http is None:
        raise UserError("--token-env belongs to --http: stdio uses no token")
    opened = open_search(request, runs, options.name)
    if http is not None:
        serve_http(opened, http, token_env)
    else:
        # A thread that waits for a line on stdin would keep a process that leaves by itself.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        serve_stdio(opened)


def mcp_config(
    *,
    client: Annotated[str, typer.Argument(metavar="CLIENT", help="claude, codex or gemini.")],
    problem: ProblemName,
    options: SearchOptions,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print the configuration with which a coding agent starts asia agent mcp.

    The configuration goes to stdout, the name of its file and notes to stderr.
    """
    from asia.errors import UserError
    from asia.interfaces.mcp.config import CLIENTS, client_configuration
    from asia.problem.load import load_problem

    if client not in CLIENTS:
        raise UserError(f"no client '{client}'; there is: {', '.join(CLIENTS)}")
    options.check()
    load_problem(problem)
    path = Path(problem)
    own = path.is_file() or (path / "problem.toml").is_file()
    words = [
        str(path.resolve()) if own else problem,
        *options.words(),
        "--runs",
        str(runs.resolve()),
    ]
    environment = {k: str(Path(os.environ[k]).resolve()) for k in _HANDED_ON if k in os.environ}
    found = client_configuration(client, words, environment)
    say_lines(found.text, end="")
    for note in found.notes:
        say(f"# {note}", file=sys.stderr)
