"""asia diff: two experiments beside each other."""

from __future__ import annotations

import difflib
from typing import Annotated

import typer

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Runs
from asia.cli._show import split_arguments


def diff(
    words: Annotated[list[str], typer.Argument(metavar="[RUN] N M", help="Two experiments.")],
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print the change of the source from experiment N to M, and both scores."""
    from rich.text import Text

    from asia.cli._output.experiment import wide_console
    from asia.errors import UserError
    from asia.ledger import describe_result, open_run

    name, numbers = split_arguments(words, 2)
    if len(numbers) != 2:
        raise UserError("diff needs two experiment numbers: asia diff [RUN] N M")
    opened = open_run(run_directory(runs, name))
    first, second = (opened.view.experiment(n) for n in numbers)
    console = wide_console()
    for e in (first, second):
        result = describe_result(e, opened.view)
        say(f"#{e.number:02d} {e.proposed.title}: {result}")
    a, b = (opened.store.text(e.proposed.source).splitlines() for e in (first, second))
    colours = {"+": "green", "-": "red", "@": "cyan"}
    for line in difflib.unified_diff(a, b, f"#{first.number}", f"#{second.number}", lineterm=""):
        console.print(Text(line, style=colours.get(line[:1], "")))
