"""asia doctor: how well can this machine keep candidates in?"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from asia.cli._options.shared import MORE, Json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from asia.sandbox import LevelState, Machine


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor", rich_help_panel=MORE)(doctor)


def doctor(json: Json = False) -> None:
    """Try every isolation level here: which works, why not more, and how to get it."""
    from asia.sandbox import machine, survey

    here, levels = machine(), survey()
    if json:
        from json import dumps

        best = next(state.level for state in levels if state.works)
        found = {"level": best, "machine": asdict(here), "levels": [asdict(s) for s in levels]}
        print(dumps(found))
    else:
        _tell(here, levels)


def _tell(here: Machine, levels: Sequence[LevelState]) -> None:
    memory = f", {here.memory_mb} MB of memory" if here.memory_mb else ""
    where = ", in a container" if here.container else ""
    print(f"machine    {here.system}, {here.architecture}, {here.cores} cores{memory}{where}")
    print(f"python     {here.python}, as {'root' if here.user == 'root' else 'an ordinary user'}")
    print(f"landlock   {f'version {here.landlock}' if here.landlock else 'none'}")
    print(f"bubblewrap {here.bubblewrap or 'none'}")
    print()
    chosen = False
    for state in levels:
        used = state.works and not chosen
        chosen = chosen or state.works
        words = f"works: {', '.join(state.layers)}" if state.works else "does not work"
        print(f"{state.level:<13}{words}{'   <- what a search uses here' if used else ''}")
        for lack in state.lacks:
            print(f"{'':<13}why not: {lack.reason}")
            print(f"{'':<13}to get it: {lack.remedy}")
    print("\ndocs/isolation.md says what each level stops and what not.")
