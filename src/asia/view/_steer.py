"""Notes and orders to a search, as `asia steer` gives them."""

from __future__ import annotations

from asia.agents import reads_notes
from asia.errors import UserError
from asia.ledger import Run
from asia.search._steering import Steering


def tell(run: Run, what: str, text: str) -> str:
    """Execute a command: steer, pause, continue or stop.

    Args:
        run: the run.
        what: the command.
        text: the note of steer.

    Returns:
        The effect of the command, as a sentence.

    Raises:
        UserError: the command cannot be executed.
    """
    steering, running = Steering(run.directory), run.state == "running"
    if what == "steer":
        steering.steer(text)
        return _noted(run, running=running)
    if what == "continue":
        words = "the search continues" if steering.paused else "the search was not paused"
        steering.go_on()
        return words
    if what not in ("pause", "stop"):
        raise UserError(f"no '{what}'; there is: steer, pause, continue, stop")
    if not running:
        raise UserError(f"run '{run.name}' is {run.state}: there is nothing to {what}")
    if what == "pause":
        steering.pause()
        return "the search pauses after its current experiment"
    steering.stop()
    return "the search stops after its present experiment; repeat its command to resume it"


def _noted(run: Run, *, running: bool) -> str:
    when = "at its next step" if running else "when the search continues"
    text, started = f"noted: recorded {when}", run.view.started
    deaf = f"; the agent '{started.agent}' does not read notes, so the note is only recorded"
    return text if reads_notes(started) else f"{text}{deaf}"
