"""asia verify: is the ledger whole?"""

from __future__ import annotations

import json as jsonlib
from dataclasses import asdict

from asia._text import say
from asia.cli._options.run_directory import run_directory
from asia.cli._options.shared import DEFAULT_RUNS, Json, RunName, Runs


def verify(run: RunName = None, runs: Runs = DEFAULT_RUNS, json: Json = False) -> None:
    """Check the chain of the ledger and every artifact it names.

    Write down the head, the hash of the last line. Only the head shows whether lines at the end of
    the ledger were removed.
    """
    from asia.ledger import Store
    from asia.ledger import verify as check

    directory = run_directory(runs, run)
    alone = not Store(directory / "artifacts").kept
    found = check(directory, ledger_alone=alone)
    if json:
        say(jsonlib.dumps({"run": directory.name, "ledger_alone": alone, **asdict(found)}))
        return
    if alone:
        say(f"{directory.name}: {found.records} events verify; there are no artifacts to check:")
        say("its sources, models and simulations are not in this folder")
    else:
        say(f"{directory.name}: {found.records} events and {found.artifacts} artifacts verify")
    say(f"head {found.head}")
    if found.torn:
        say(f"{found.torn} bytes of a line that was cut off while it was written are passed over")
