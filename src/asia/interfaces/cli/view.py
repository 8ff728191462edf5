"""asia view: live pages of the runs in a browser."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, Runs, run_directory


def view(
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN]",
            help="Path or name of a run, or a folder of runs; left out: all below --runs.",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for any free one.")
    ] = 8731,
    open_: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Show running searches in a browser: curves, experiments, steering. Ctrl-C ends it.

    The printed address contains a token that the pages require.
    """
    from asia.interfaces.view import require_server, serve_view

    require_server()
    if run is not None and Path(run).is_dir() and not (Path(run) / "ledger.jsonl").exists():
        folder, name = Path(run).resolve(), None
    elif run is None and runs.is_dir():
        folder, name = runs.resolve(), None
    else:
        # A workspace has its runs in another folder, and may hide them.
        directory = run_directory(runs, run).resolve()
        folder, name = directory.parent, None if run is None else directory.name

    def started(address: str) -> None:
        say(f"view     {address}")
        say("Ctrl-C ends", flush=True)
        if open_:
            webbrowser.open(address)

    serve_view(folder, name, port, started)
