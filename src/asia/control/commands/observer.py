"""asia export --observer: the observer of asia monitor as C."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer

from asia._text import say
from asia.errors import UserError


def observer_options(
    command: Callable[[], None],
    given: Mapping[str, Any],
    *,
    observer: Annotated[
        bool,
        typer.Option(
            "--observer", help="With --to c: also the observer of asia monitor, in observer."
        ),
    ] = False,
    parameter: Annotated[
        list[str] | None,
        typer.Option(help="Parameter that the observer estimates, as for asia monitor."),
    ] = None,
) -> None:
    to, model, options = given["to"] or (), given["model"], given["options"]
    if to and (observer or parameter) and ("c" not in to or not observer):
        raise UserError("--observer belongs to --to c, and --parameter to --observer")
    command()
    if not observer:
        return
    from asia.control.monitor import Monitor, export_observer
    from asia.export.pipeline import table
    from asia.interfaces.cli.export import parity_json

    if model is not None and model != "refit" and not model.isdigit():
        raise UserError(f"--observer: give --model refit or an experiment, not {model}")
    directory = options.directory(given["run"])
    found = Monitor(directory, parameter or (), model=model, isolation=options.level)
    folder = (given["out"] or directory / "export") / "c" / "observer"
    files, row = export_observer(found, folder)
    if options.json:
        say(parity_json(row.target, files, [row]))
    options.print([*table([row])[1:], str(folder)])
