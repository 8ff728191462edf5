"""Which run a command is about."""

from __future__ import annotations

from pathlib import Path

from asia.cli._options.shared import DEFAULT_RUNS


def run_directory(runs: Path, name: str | None, *, named: bool = False) -> Path:
    """As `asia.ledger.find_run`. In a workspace, where no other folder of runs was named, the run
    that is left out is the workspace's own, and a name is one of its neighbours. `named`: a
    workspace's own run must be named, for what cannot be undone. Raises UserError."""
    from asia.drive import Workspace
    from asia.errors import UserError
    from asia.ledger import find_run

    place = Workspace.around(Path()) if runs == DEFAULT_RUNS else None
    if place is None:
        return find_run(runs, name)
    if place.run is None:
        raise UserError(
            f"{place.folder} is the folder of a coding agent, which does not see its run: read "
            "results.tsv and search_journal.md there, or give the command outside this folder"
        )
    if name is not None:
        return find_run(place.run.parent, name)
    if not (place.run / "ledger.jsonl").is_file():
        raise UserError(
            f"the search of this workspace, {place.run.name}, has not begun: asia try begins it"
        )
    if named:
        raise UserError(
            f"this cannot be undone: name the run of this workspace, {place.run.name}, to go on"
        )
    return place.run
