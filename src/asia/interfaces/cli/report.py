"""asia report: the page and the pictures of a run; figures, tables and methods for a paper."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, RunName, Runs, run_directory
from asia.interfaces.cli.output import fact_line, verdict_facts
from asia.ledger.artifacts import Store
from asia.ledger.run import open_run
from asia.presentation.integrity import seal_text


def report(
    run: RunName = None,
    figures: Annotated[
        Path | None, typer.Option(help="Only write the figures for a paper there: PDF, SVG, PNG.")
    ] = None,
    latex: Annotated[
        Path | None, typer.Option(help="Only write the tables for a paper there, in LaTeX.")
    ] = None,
    methods: Annotated[
        bool, typer.Option("--methods", help="Only print the paragraph on methods for a paper.")
    ] = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Write a run as one HTML page, and its pictures as PNG and PDF."""
    from asia.report.files import write_figures, write_report
    from asia.report.page.page import write_page
    from asia.report.paper import methods_paragraph, write_tables

    directory = run_directory(runs, run)
    if figures is not None:
        for path in write_figures(directory, figures):
            say(str(path))
    if latex is not None:
        for path in write_tables(directory, latex):
            say(str(path))
    if methods:
        say(methods_paragraph(directory))
    if figures is not None or latex is not None or methods:
        return
    failed: list[str] = []
    for path in (write_page(directory), *write_report(directory, failed=failed)):
        say(str(path))
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    view = open_run(directory).view
    if words := seal_text(directory, view):
        say(words, file=sys.stderr)
    for label, text in verdict_facts(view):
        say(fact_line(label, text), file=sys.stderr)
    if not Store(directory / "artifacts").kept:
        say(
            "other pictures left out: they need simulations, and the run has no artifacts",
            file=sys.stderr,
        )
