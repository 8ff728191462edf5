"""asia validate --ablate: the gain of the winner in parts."""

from __future__ import annotations

import json as jsonlib
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from asia._text import say

if TYPE_CHECKING:
    from asia.ledger.events import AblationFit


def ablate_winner(directory: Path, seeds: int, *, json: bool) -> None:
    """Fit the winner of a finished search with parts taken back: its model with the baseline's
    training, its training with the baseline's model, and without each change of its lineage."""
    from asia.analysis.ablation import ablate
    from asia.interfaces.cli.results import ablation_lines
    from asia.ledger.run import open_run
    from asia.report import write_report

    found, new = ablate(directory, _print_json if json else _print, seeds=seeds)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in ablation_lines(found, open_run(directory).view.v_name):
        say(line)
    for picture in write_report(directory):
        if picture.name == "ablation.png":
            say(f"picture  {picture}")


def _print(event: AblationFit, done: int, total: int) -> None:
    from asia._timer import duration
    from asia.ledger.text import error_value

    value = event.failed if event.value is None else f"V={error_value(event.value)}"
    text = f"{event.variant}, seed {event.repeat}: {value} in {duration(event.seconds)}"
    say(f"{text}  [{done} of {total}]", file=sys.stderr, flush=True)


def _print_json(event: AblationFit, done: int, total: int) -> None:
    fit = {"event": "ablation_fit", "variant": event.variant, "seed": event.repeat}
    line = {**fit, "V": event.value, "failed": event.failed, "done": done, "of": total}
    say(jsonlib.dumps(line, allow_nan=False), flush=True)
