"""Checks of a run folder before anything in it is read or written, since it may come from somebody
else; and the workspaces of this user, in which no run is accepted."""

import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path

from asia._files import config_folder, kind_of, name_of_place, read_private, write_private
from asia.errors import UserError

# Workspaces: an agent may write everything in there. So the run of a workspace is kept in the
# user's config folder, and a run inside a workspace is refused.


MARK = ".asia/workspace.json"
"""File in a workspace that says that it is one, and nothing else."""


@dataclass(frozen=True)
class WorkspaceLink:
    """A workspace and its run, as recorded when the workspace was made."""

    folder: Path
    run: Path | None
    """Run directory; None for the folder of a command agent."""


def link_workspace(folder: Path, run: Path | None) -> None:
    """Record the run of a workspace outside it. Raises UserError."""
    path = link_path(folder)
    text = json.dumps({"folder": str(folder.resolve()), "run": None if run is None else str(run)})
    try:
        write_private(path, f"{text}\n".encode())
    except OSError as error:
        raise UserError(
            f"cannot write {path} ({error.strerror}): name a folder of yours with XDG_CONFIG_HOME"
        ) from None


def linked_workspace(folder: Path) -> WorkspaceLink | None:
    """Return the link of this folder; None where this user has made no workspace there."""
    try:
        data = read_private(link_path(folder))
    except OSError:
        return None
    if data is None:
        return None
    try:
        found = json.loads(data)
        run = None if found["run"] is None else Path(found["run"])
    except (ValueError, KeyError, TypeError):
        return None
    return WorkspaceLink(folder.resolve(), run)


def workspace_around(path: Path) -> Path | None:
    """Return the workspace that holds `path`; None where there is none."""
    real = path.resolve()
    for place in (real, *real.parents):
        if os.path.lexists(place / MARK) or linked_workspace(place) is not None:
            return place
    return None


def link_path(folder: Path) -> Path:
    """Return the file that records the run of a workspace."""
    # The owner counts: a folder that another user made at the same place is another one.
    return config_folder() / "workspaces" / name_of_place(folder, os.stat(folder).st_uid)


# Files of a run.


_MIB = 1 << 20
_FILES: dict[str, int | None] = {
    "ledger.jsonl": None,
    "ledger.holder": _MIB,
    "problem.lock.toml": 64 * _MIB,
    "error.txt": 16 * _MIB,
    "results.tsv": None,
    "search_journal.md": None,
}
"""Names of files, and the largest size in bytes of those that are read at once."""
_FOLDERS = ("artifacts", "control", "report", "export")
_WALKED = ("control", "report")
_DEEPEST, _MOST_ENTRIES = 4, 20_000
_REMEDY = "a run holds ordinary files and folders alone; use it only if you know who made it"


def check_run_folder(directory: Path) -> None:
    """Check that a run folder has ordinary files and folders under the names that ASIA reads and
    writes, and that it lies in no workspace. A link could name any file of the user, and to open a
    named pipe could wait for ever. Raises UserError with the first name that is something else."""
    place = workspace_around(directory)
    if place is not None:
        raise UserError(
            f"{directory} lies in the workspace {place}, where an agent can write: a run in there "
            "may be forged, so it is not read"
        )
    for name, most in _FILES.items():
        _check(directory / name, stat.S_IFREG, most)
    for name in _FOLDERS:
        _check(directory / name, stat.S_IFDIR)
    left = _MOST_ENTRIES
    for name in _WALKED:
        left = _check_below(directory / name, _DEEPEST, left)


def _check(path: Path, wanted: int, most: int | None = None) -> None:
    try:
        found = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    if stat.S_IFMT(found.st_mode) != wanted:
        kind = kind_of(found.st_mode)
        raise UserError(f"{path} is {kind}, not {kind_of(wanted)}: {_REMEDY}")
    if most is not None and found.st_size > most:
        raise UserError(f"{path} has {found.st_size} bytes, at most {most} are read: {_REMEDY}")


def _check_below(folder: Path, depth: int, left: int) -> int:
    """Check what is below a folder; the number of entries that may still come."""
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                left -= 1
                if left < 0 or depth == 0:
                    raise UserError(
                        f"{folder} has more files, or deeper folders, than ASIA writes: {_REMEDY}"
                    )
                mode = entry.stat(follow_symlinks=False).st_mode
                if stat.S_ISDIR(mode):
                    left = _check_below(Path(entry.path), depth - 1, left)
                elif not stat.S_ISREG(mode):
                    kind = kind_of(mode)
                    raise UserError(f"{entry.path} is {kind}, not an ordinary file: {_REMEDY}")
    except FileNotFoundError:
        # Not there yet, or removed meanwhile: a search empties its queue.
        pass
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}") from None
    return left
