"""asia verify: is the record whole?"""

from __future__ import annotations

import typer

from asia.cli._options import DEFAULT_RUNS, MORE, RunName, Runs


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("verify", rich_help_panel=MORE)(verify)


def verify(run: RunName = None, runs: Runs = DEFAULT_RUNS) -> None:
    """Check the chain of records and every artifact they name."""
    from asia.ledger import find_run
    from asia.ledger import verify as check

    directory = find_run(runs, run)
    found = check(directory)
    print(
        f"{directory.name}: {found.records} records and {found.artifacts} artifacts verify, "
        f"head {found.head[:16]}"
        + (f"; {found.torn} bytes of a record cut off while it was written" if found.torn else "")
    )
