"""asia validate --repeat: the best candidates fitted again from other seeds."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from asia._text import say

if TYPE_CHECKING:
    from asia.ledger.events import Repeated


def repeat_candidates(directory: Path, top: int, seeds: int, *, json: bool) -> None:
    """Fit the `top` best candidates of a finished search from other seeds on every fold. Print
    which of them differ significantly, and the error to expect of the winner."""
    from asia.analysis.confirmation import confirm
    from asia.interfaces.cli.results import confirmation_lines
    from asia.ledger.run import open_run

    found, new = confirm(directory, _print_json if json else _print, top=top, seeds=seeds)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in confirmation_lines(found, open_run(directory).view.v_name):
        say(line)


def _print(event: Repeated, done: int, total: int) -> None:
    from asia._timer import duration
    from asia.interfaces.cli.text import value_words

    same = ", as in the search: its fits do not depend on the seed" if event.same else ""
    say(
        f"#{event.experiment:02d} seed {event.repeat}: V={value_words(event.outcome)} in "
        f"{duration(event.seconds)}{same}  [{done} of {total}]",
        file=sys.stderr,
        flush=True,
    )


def _print_json(event: Repeated, done: int, total: int) -> None:
    from asia.judge.scoring.outcome import Score

    value = event.outcome.value if isinstance(event.outcome, Score) else None
    fit = {"event": "repeated", "experiment": event.experiment, "repeat": event.repeat}
    line = {**fit, "V": value, "same": event.same, "done": done, "of": total}
    say(jsonlib.dumps(line, allow_nan=False), flush=True)
