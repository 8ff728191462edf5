"""asia report: pictures of a run."""

from __future__ import annotations

from asia._text import say
from asia.cli._options.shared import DEFAULT_RUNS, RunName, Runs


def report(run: RunName = None, runs: Runs = DEFAULT_RUNS) -> None:
    """Draw a run as PNG and PDF pictures."""
    from asia.ledger import find_run
    from asia.report import write_report

    for path in write_report(find_run(runs, run)):
        say(str(path))
