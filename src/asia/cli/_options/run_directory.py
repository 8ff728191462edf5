"""Resolution of the argument RUN."""

from __future__ import annotations

from pathlib import Path

from asia.cli._options.shared import DEFAULT_RUNS


def run_directory(runs: Path, name: str | None, *, named: bool = False) -> Path:
    """Find the run as `asia.ledger.find_run` does. In a workspace, without --runs, the default is
    the run of the workspace, and a name is a run in the same folder. named: require a name in a
    workspace, for actions that cannot be undone. Raises UserError."""
    from asia.drive import Workspace
    from asia.errors import UserError
    from asia.ledger import find_run

    place = Workspace.around(Path()) if runs == DEFAULT_RUNS else None
    if place is None:
        return find_run(runs, name)
    if place.run is None:
        raise UserError(
            f"{place.folder} is the folder of a coding agent, which does not see its run: read "
            "results.tsv and search_journal.md there, or run the command outside this folder"
        )
    if name is not None:
        return find_run(place.run.parent, name)
    if not (place.run / "ledger.jsonl").is_file():
        raise UserError(
            f"the search of this workspace, {place.run.name}, has not started: asia try starts it"
        )
    if named:
        raise UserError(
            f"this cannot be undone: name the run of this workspace, {place.run.name}, to continue"
        )
    return place.run
