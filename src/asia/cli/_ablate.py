"""asia ablate: what is the gain due to?"""

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
    from asia.ledger import AblationFit


def ablate(
    run: RunName = None,
    seeds: Annotated[
        int,
        typer.Option(min=1, help="Seeds for each variant; fewer where they do not matter."),
    ] = 3,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Fit the winner of a finished search with parts taken back: its model with the baseline's
    training, its training with the baseline's model, and without each change of its lineage.

    Uses training records alone. After an interrupt, the same command continues.
    """
    from asia.cli._output.ablation import ablation_lines
    from asia.ledger import open_run
    from asia.report import write_report
    from asia.search import ablate as take_apart

    directory = run_directory(runs, run)
    found, new = take_apart(directory, _print_json if json else _print, seeds=seeds)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("ablated before: nothing was fitted again", file=sys.stderr)
    for line in ablation_lines(found, open_run(directory).view.v_name):
        say(line)
    for picture in write_report(directory):
        if picture.name == "ablation.png":
            say(f"picture  {picture}")


def _print(event: AblationFit, done: int, total: int) -> None:
    from asia.cli._output.words import duration
    from asia.ledger import error_value

    value = event.failed if event.value is None else f"V={error_value(event.value)}"
    words = f"{event.variant}, seed {event.repeat}: {value} in {duration(event.seconds)}"
    say(f"{words}  [{done} of {total}]", file=sys.stderr, flush=True)


def _print_json(event: AblationFit, done: int, total: int) -> None:
    words = {"event": "ablation_fit", "variant": event.variant, "seed": event.repeat}
    line = {**words, "V": event.value, "failed": event.failed, "done": done, "of": total}
    say(jsonlib.dumps(line, allow_nan=False), flush=True)
