"""A problem directory that is written whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from asia._files import sync_folder
from asia.errors import UserError
from asia.problem._load import load_problem
from asia.problem.new.text import RecordRows


def check_directory(directory: Path) -> None:
    """Raise UserError unless a new problem can be written there."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise UserError(f"{directory} is a file: choose another name for the problem")
    if any(directory.iterdir()):
        raise UserError(
            f"{directory} exists and is not empty: choose another name, nothing is overwritten"
        )


def write_directory(
    directory: Path,
    files: Sequence[tuple[str, str | RecordRows]],
    seal: Callable[[Path], Path] | None = None,
) -> Path | None:
    """Write `files`, names and texts, and load the problem, all or nothing.

    A temporary directory next to the final one is filled, loaded, then renamed.

    Args:
        seal: writes the store, and returns the path of its key

    Returns:
        the path of the key

    Raises:
        UserError: when the directory cannot be written or loaded
    """
    above = [p for p in directory.parents if not p.exists()]
    key: Path | None = None
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{directory.name}-", dir=directory.parent))
    except OSError as error:
        raise UserError(f"cannot write to {directory.parent}: {error.strerror}") from error
    try:
        for name, text in files:
            with (draft / name).open("w", encoding="utf-8") as file:
                file.writelines([text] if isinstance(text, str) else text.blocks())
        load_problem(draft)
        key = seal(draft) if seal else None
        draft.chmod(0o755)
        draft.rename(directory)
        sync_folder(directory.parent)
    except OSError as error:
        raise UserError(f"cannot write {directory}: {error.strerror}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        if not directory.exists():
            if key is not None:
                key.unlink(missing_ok=True)
            for made in above:
                made.rmdir()
    return key
