"""asia steer and asia note: steer a running search, and keep notes on a run."""

import getpass
import json as jsonlib
from dataclasses import asdict
from typing import Annotated

import typer

from asia._text import one_line, say
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, RunName, Runs, run_directory
from asia.ledger.events import Noted
from asia.ledger.run import open_run


def steer(
    run: RunName = None,
    note: Annotated[
        str | None,
        typer.Option(
            "--note", metavar="TEXT", help="Write a note; the agent reads it at its next step."
        ),
    ] = None,
    pause: Annotated[
        bool, typer.Option("--pause", help="Pause after the current experiment.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="End the pause.")] = False,
    stop: Annotated[
        bool,
        typer.Option(
            "--stop",
            help="Stop after the current experiment. The command that began the search resumes it.",
        ),
    ] = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Send a note to the agent of a running search; pause, resume or stop the search."""
    from asia.agents.registry import reads_notes
    from asia.search.steering import Steering

    given = {"pause": pause, "resume": resume, "stop": stop}
    orders = [order for order, wanted in given.items() if wanted]
    if len(orders) > 1:
        raise UserError(f"--{orders[0]} and --{orders[1]} do not go together: give one of them")
    if not orders and note is None:
        raise UserError("nothing to do: give --note TEXT, --pause, --resume or --stop")
    opened = open_run(run_directory(runs, run))
    if (pause or stop) and opened.state != "running":
        raise UserError(f"run '{opened.name}' is {opened.state}: there is nothing to {orders[0]}")
    steering, name = Steering(opened.directory), opened.name
    if note is not None:
        steering.steer(note)
        when = "at its next step" if opened.state == "running" else "when the search continues"
        say(f"noted for {name}: recorded {when}")
        if not reads_notes(opened.view.started):
            agent = opened.view.started.agent
            say(f"note     the agent '{agent}' reads no notes; the ledger keeps it for people")
    if stop:
        steering.stop()
        say(f"{name} stops after its current experiment")
    elif resume:
        say(f"{name} continues" if steering.paused else f"{name} was not paused")
        steering.go_on()
    elif pause:
        to_resume = f"asia steer {name} --resume continues it"
        if steering.paused:
            say(f"{name} is already paused; {to_resume}")
        else:
            steering.pause()
            say(f"{name} pauses after its current experiment; {to_resume}")


def note(
    run: RunName = None,
    text: Annotated[
        str | None, typer.Argument(metavar="[TEXT]", help="The note, or the reason of the tags.")
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
