"""Files that a user names, with clear errors for anything but ordinary files; folders that are
safely on the disk."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from asia.errors import UserError

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFBLK: "a device",
    stat.S_IFCHR: "a device",
}


def read_file(path: Path, remedy: str) -> bytes:
    """The bytes of an ordinary file. Never waits for a named pipe, and opens no device. Raises
    UserError that says what `path` is instead, and ends with the remedy."""
    try:
        # Looked at before it is opened, for opening a device can do something by itself.
        _check_ordinary(path, path.stat().st_mode, remedy)
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(fd, "rb") as stream:
            _check_ordinary(path, os.fstat(fd).st_mode, remedy)
            return stream.read()
    except FileNotFoundError:
        what = f"{path}, a broken link" if path.is_symlink() else str(path)
        raise UserError(f"no such file: {what}; {remedy}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; {remedy}") from None


def read_text(path: Path, remedy: str) -> str:
    """The text of an ordinary file in UTF-8. Raises UserError as `read_file`."""
    try:
        return read_file(path, remedy).decode("utf-8")
    except UnicodeDecodeError:
        raise UserError(f"{path} is not UTF-8 text: save it as UTF-8") from None


def sync_folder(path: Path) -> None:
    """The names in a folder are on the disk on return."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _check_ordinary(path: Path, mode: int, remedy: str) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "no file")
        raise UserError(f"cannot read {path}: it is {kind}, not an ordinary file; {remedy}")
