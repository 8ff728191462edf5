"""asia report: pictures of a run."""

from __future__ import annotations

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, RunName, Runs


def report(run: RunName = None, runs: Runs = DEFAULT_RUNS) -> None:
    """Draw a run as PNG and PDF pictures."""
    from asia.report import write_report

    for path in write_report(run_directory(runs, run)):
        say(str(path))
