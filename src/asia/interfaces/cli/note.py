"""asia note: notes and tags for people, in the ledger of a run."""

from __future__ import annotations

import getpass
import json as jsonlib
from dataclasses import asdict
from typing import Annotated

import typer

from asia._text import one_line, say
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, RunName, Runs, run_directory
from asia.ledger.events import Noted
from asia.ledger.run import open_run


def note(
    run: RunName = None,
    text: Annotated[
        str | None,
        typer.Argument(metavar="[TEXT]", help="The note, or the reason of the tags."),
    ] = None,
    experiment: Annotated[
        int, typer.Option(min=0, help="Number of an experiment; default: the run as a whole.")
    ] = 0,
    tag: Annotated[list[str] | None, typer.Option(help="Tag to add, repeatable.")] = None,
    untag: Annotated[list[str] | None, typer.Option(help="Tag to remove, repeatable.")] = None,
    author: Annotated[str | None, typer.Option(help="Default: your user name.")] = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Note something on a run or on an experiment, and tag it. The ledger keeps author, reason and
    time; agents do not see it. Without TEXT: print the notes and tags of a run."""
    from asia.search.steering import note_for_people

    opened = open_run(run_directory(runs, run))
    if text is not None or tag or untag:
        name, words = author or getpass.getuser(), text or ""
        done = note_for_people(opened, name, words, experiment, tag or (), untag or ())
        when = "recorded" if done else "the running command records it at its next step"
        say(f"noted for {opened.name}: {when}")
        return
    for line in opened.lines:
        one = line.event
        if not isinstance(one, Noted) or (experiment and one.experiment != experiment):
            continue
        if json:
            say(jsonlib.dumps({"time": line.time, **asdict(one)}, ensure_ascii=False))
            continue
        place = f"#{one.experiment:02d}" if one.experiment else "run"
        changes = [*(f"+{word}" for word in one.tags), *(f"-{word}" for word in one.removed)]
        what = " ".join((*changes, one_line(one.text, 500)))
        say(f"{line.time[:16].replace('T', ' ')}  {place:<4} {one.author}: {what}")
