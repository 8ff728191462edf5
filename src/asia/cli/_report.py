"""asia report: the page and the pictures of a run."""

from __future__ import annotations

import sys

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, RunName, Runs


def report(run: RunName = None, runs: Runs = DEFAULT_RUNS) -> None:
    """Write a run as one HTML page, and draw it as PNG and PDF pictures."""
    from asia.cli._output.words import use_lines
    from asia.ledger import Store, open_run
    from asia.report import write_page, write_report

    directory = run_directory(runs, run)
    for path in (write_page(directory), *write_report(directory)):
        say(str(path))
    for line in use_lines(open_run(directory).view):
        say(line, file=sys.stderr)
    if not Store(directory / "artifacts").kept:
        say(
            "the other pictures need the simulations, and the ledger came without its artifacts",
            file=sys.stderr,
        )
