"""asia steer, pause, stop: a word to a search that runs."""

from __future__ import annotations

from typing import Annotated

import typer

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, RunName, Runs


def steer(
    run: Annotated[str, typer.Argument(help="Path or name of the run.")],
    text: Annotated[str, typer.Argument(help="What the agent should know or try.")],
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Write a note for the agent into the ledger. The agent reads it at its next step."""
    from asia.agents import reads_notes
    from asia.ledger import open_run
    from asia.search import Steering

    opened = open_run(run_directory(runs, run))
    Steering(opened.directory).steer(text)
    started = opened.view.started
    when = "at its next step" if opened.state == "running" else "when the search continues"
    say(f"noted for {opened.name}: recorded {when}")
    if not reads_notes(started):
        say(f"note     the agent '{started.agent}' reads no notes; the ledger keeps it for people")


def pause(
    run: RunName = None,
    go_on: Annotated[bool, typer.Option("--end", help="End the pause.")] = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Pause the search after the current experiment, until asia pause --end."""
    from asia.errors import UserError
    from asia.ledger import open_run
    from asia.search import Steering

    opened = open_run(run_directory(runs, run))
    steering, name = Steering(opened.directory), opened.name
    if go_on:
        words = f"{name} continues" if steering.paused else f"{name} was not paused"
        steering.go_on()
        say(words)
    elif opened.state != "running":
        raise UserError(f"run '{name}' is {opened.state}: there is nothing to pause")
    elif steering.paused:
        say(f"{name} is already paused; asia pause {name} --end continues it")
    else:
        steering.pause()
        say(f"{name} pauses after its current experiment; asia pause {name} --end continues it")


def stop(run: RunName = None, runs: Runs = DEFAULT_RUNS) -> None:
    """End the search after the current experiment. The command that began it can continue it."""
    from asia.errors import UserError
    from asia.ledger import open_run
    from asia.search import Steering

    opened = open_run(run_directory(runs, run))
    if opened.state != "running":
        raise UserError(f"run '{opened.name}' is {opened.state}: there is nothing to stop")
    Steering(opened.directory).stop()
    say(f"{opened.name} stops after its present experiment")
