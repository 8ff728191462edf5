"""asia show N M: two experiments side by side."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

from asia._text import say

if TYPE_CHECKING:
    from asia.ledger.run import Run
    from asia.ledger.view import Experiment


def print_difference(opened: Run, first: Experiment, second: Experiment) -> None:
    """Print both results, then the change of the source from the first to the second."""
    from rich.text import Text

    from asia.interfaces.cli.results import wide_console
    from asia.ledger.text import describe_result

    console = wide_console()
    for e in (first, second):
        result = describe_result(e, opened.view)
        say(f"#{e.number:02d} {e.proposed.title}: {result}")
    a, b = (opened.store.text(e.proposed.source).splitlines() for e in (first, second))
    colours = {"+": "green", "-": "red", "@": "cyan"}
    for line in difflib.unified_diff(a, b, f"#{first.number}", f"#{second.number}", lineterm=""):
        console.print(Text(line, style=colours.get(line[:1], "")))
