"""asia doctor: isolation levels, plugins and attacks on this machine."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._plugins import Part
from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import Json

if TYPE_CHECKING:
    from asia.judge.sandbox.availability import LevelState, Machine

_INDENT = 13
WINDOWS = (
    "ASIA does not run on Windows directly. Run `wsl --install` in PowerShell to get Linux in "
    "WSL2. Then install ASIA in that Linux."
)
MACOS = (
    "ASIA was not tested on macOS. Candidates run at level sandbox-exec or process, without a "
    "memory limit. Use a Linux virtual machine or container for level namespace or landlock."
)


def doctor(
    *,
    executor: Annotated[
        str | None,
        typer.Option(
            help="Test the machines of an executor instead: dask://HOST:PORT or dask:FILE."
        ),
    ] = None,
    attack: Annotated[
        bool,
        typer.Option(
            "--attack",
            help="Run one attack of each kind against the isolation levels of this machine. Exit "
            "code 1 if one is not stopped.",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Test every isolation level on this machine, print how to enable a stronger one, and list the
    installed plugins."""
    from asia._plugins import OWN, parts
    from asia.judge.sandbox.availability import machine, survey
    from asia.judge.sandbox.layers.pids import most_pids

    if attack and executor is not None:
        raise UserError("--attack and --executor do not go together: attacks aim at this machine")
    if attack:
        _attack(json=json)
        return
    if executor is not None:
        _print_executor(executor, json=json)
        return
    here, levels = machine(), survey()
    used = next(state.level for state in levels if state.works)
    found, clash = (), None
    try:
        found = tuple(part for part in parts() if part.package != OWN)
    except UserError as error:
        clash = str(error)
    if not json:
        _print_machine(here)
        _print_levels(levels)
        _print_parts(found, clash)
        say()
        say("docs/isolation.md lists the attacks that each level stops.")
        return
    listed: list[dict[str, Any]] = []
    for part in found:
        fields = asdict(part)
        kind = fields.pop("group").removeprefix("asia.")
        listed.append({"kind": kind, **fields, "failure": part.why_not()})
    answer = {
        "level": used,
        "machine": asdict(here),
        "levels": [asdict(state) for state in levels],
        "most_pids": most_pids(),
        "parts": listed,
        "clash": clash,
    }
    say(jsonlib.dumps(answer))


def _print_executor(name: str, *, json: bool) -> None:
    """Print every worker of an executor. Exit code 2 if one cannot work for a search from here."""
    from asia.judge.evaluation.machines import survey_machines
    from asia.judge.executors import make_executor, remote_executor_of

    remote = remote_executor_of(make_executor(name))
    states = [] if remote is None else survey_machines(remote)
    if json:
        say(jsonlib.dumps({"executor": name, "workers": [asdict(state) for state in states]}))
    elif remote is None:
        say(f"executor {name} fits folds on this machine: run asia doctor without --executor")
    for state in () if json else states:
        level = f"{state.isolation} ({', '.join(state.layers)})" if state.isolation else "none"
        say(
            f"worker     {state.worker} on {state.machine}, {state.cores} cores, "
            f"isolation {level}, round trip {1000 * state.round_trip:.0f} ms, "
            f"clock {state.clock:+.2f} s"
        )
        if state.unlike:
            say(f"{'':<11}{state.unlike}")
    if any(state.unlike or not state.isolation for state in states):
        raise typer.Exit(2)


def _print_machine(here: Machine) -> None:
    if sys.platform == "darwin":
        say(f"macOS      {MACOS}")
    memory = f", {here.memory_mb} MB of memory" if here.memory_mb else ""
    where = ", in a container" if here.container else ""
    say(f"machine    {here.system}, {here.architecture}, {here.cores} cores{memory}{where}")
    say(f"python     {here.python}, as {'root' if here.user == 'root' else 'an ordinary user'}")
    say(f"landlock   {f'version {here.landlock}' if here.landlock else 'none'}")
    say(f"bubblewrap {here.bubblewrap or 'none'}")


def _print_levels(levels: Sequence[LevelState]) -> None:
    from asia.judge.sandbox.layers.pids import REMEDY, PidsMechanism, most_pids

    say()
    chosen = False
    for state in levels:
        used = state.works and not chosen
        chosen = chosen or state.works
        words = f"works: {', '.join(state.layers)}" if state.works else "does not work"
        say(f"{state.level:<{_INDENT}}{words}{'   <- what a search uses here' if used else ''}")
        if state.pids is not None:
            held = f"at most {most_pids()} threads and processes a worker, held by {state.pids}"
            say(f"{'':<{_INDENT}}{held}")
            if state.pids is PidsMechanism.WATCHER:
                say(f"{'':<{_INDENT}}{REMEDY}")
        for lack in state.lacks:
            say(f"{'':<{_INDENT}}why not: {lack.reason}")
            say(f"{'':<{_INDENT}}to get it: {lack.remedy}")


def _print_parts(found: Sequence[Part], clash: str | None) -> None:
    say()
    if not found:
        say(f"{'plugged in':<{_INDENT}}{clash or 'nothing: no other package adds a part'}")
        return
    heads = [f"{p.group.removeprefix('asia.')} {p.name}" for p in found]
    width = max(_INDENT, *(len(head) + 2 for head in heads))
    for head, part in zip(heads, found, strict=True):
        say(f"{head:<{width}}{part.target}, of {part.package} {part.version}")
        if failure := part.why_not():
            say(f"{'':<{width}}does not load: {failure}")


def _attack(*, json: bool) -> None:
    """Run one attack of each kind at every level that confines candidates here. Exit code 1 if one
    succeeds, or does not end as it must."""
    from asia.judge.sandbox.availability import fitting_levels, why_not
    from asia.testing.attacks import run_attacks

    walled = [level.isolation for level in fitting_levels() if level.confined]
    working = [level for level in walled if why_not(level) is None]
    if not working:
        raise UserError(
            f"no level of {', '.join(walled)} works here, and attacks run nowhere else: "
            "`asia doctor` says how to get one"
        )
    stopped: list[bool] = []
    for level in working:
        for result in run_attacks(level):
            stopped.append(result.stopped)
            verdict = "stopped" if result.stopped else "NOT STOPPED"
            line = f"{result.level:<{_INDENT}}{verdict}: {result.attack} ({result.how})"
            say(jsonlib.dumps(asdict(result)) if json else line, flush=True)
    say(
        f"{sum(stopped)} of {len(stopped)} attacks stopped", file=sys.stderr if json else sys.stdout
    )
    if not all(stopped):
        raise typer.Exit(1)
