"""asia verify: check the ledger, or repeat the search."""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict
from typing import Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, RunName, Runs, run_directory
from asia.interfaces.cli.replay import replay_search


def verify(
    run: RunName = None,
    replay: Annotated[
        bool,
        typer.Option(
            "--replay",
            help="Repeat the search instead: query the agent and evaluate every candidate again. "
            "Needs no network and no key, and writes nothing.",
        ),
    ] = False,
    from_scratch: Annotated[
        bool,
        typer.Option(
            "--from-scratch",
            help="With --replay on another machine: compare within --tolerance, not bitwise.",
        ),
    ] = False,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Relative difference of V allowed with --from-scratch.")
    ] = 0.01,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Check the hash chain of the ledger and every artifact that it names.

    Keep a copy of the head, the hash of the last line: only the head shows whether lines at the end
    were removed. --replay does not evaluate experiments that the deadline affected. Exit code 1:
    an outcome differs.
    """
    from asia.errors import UserError
    from asia.ledger.artifacts import Store
    from asia.ledger.verification import verify as check

    if from_scratch and not replay:
        raise UserError("--from-scratch belongs to --replay: add --replay or leave it out")
    directory = run_directory(runs, run)
    if replay:
        replay_search(directory, tolerance if from_scratch else 0.0, json=json)
        return
    alone = not Store(directory / "artifacts").kept
    found = check(directory, ledger_alone=alone)
    if json:
        say(jsonlib.dumps({"run": directory.name, "ledger_alone": alone, **asdict(found)}))
        return
    if alone:
        say(f"{directory.name}: {found.records} events verify")
        say("no artifacts checked: sources, models and simulations are not in this folder")
    else:
        say(f"{directory.name}: {found.records} events and {found.artifacts} artifacts verify")
    say(f"head {found.head}")
    if found.torn:
        say(f"the last line is incomplete: its {found.torn} bytes were ignored")
