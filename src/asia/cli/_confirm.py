"""asia confirm: is the winner better, or was it lucky?"""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Json, RunName, Runs

if TYPE_CHECKING:
    from asia.ledger import Repeated


def confirm(
    run: RunName = None,
    top: Annotated[
        int, typer.Option(min=1, help="How many candidates to repeat, the lowest V first.")
    ] = 3,
    seeds: Annotated[
        int, typer.Option(min=1, help="Seeds for each; one where fits do not depend on it.")
    ] = 5,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Fit the best candidates of a finished search again from other seeds, on every fold, and say
    which can be told apart, and what error to expect of the winner.

    Uses training records alone. After an interrupt, the same command continues.
    """
    from asia.cli._output.confirmation import confirmation_lines
    from asia.ledger import open_run
    from asia.search import confirm as repeat

    directory = run_directory(runs, run)
    found, new = repeat(directory, _print_json if json else _print, top=top, seeds=seeds)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("confirmed before: nothing was fitted again", file=sys.stderr)
    for line in confirmation_lines(found, open_run(directory).view.v_name):
        say(line)


def _print(event: Repeated, done: int, total: int) -> None:
    from asia.cli._output.words import duration, value_words

    same = ", as in the search: its fits do not depend on the seed" if event.same else ""
    say(
        f"#{event.experiment:02d} seed {event.repeat}: V={value_words(event.outcome)} in "
        f"{duration(event.seconds)}{same}  [{done} of {total}]",
        file=sys.stderr,
        flush=True,
    )


def _print_json(event: Repeated, done: int, total: int) -> None:
    from asia.scoring import Score

    value = event.outcome.value if isinstance(event.outcome, Score) else None
    words = {"event": "repeated", "experiment": event.experiment, "repeat": event.repeat}
    line = {**words, "V": value, "same": event.same, "done": done, "of": total}
    say(jsonlib.dumps(line, allow_nan=False), flush=True)
