"""Safe writing into a folder that other processes may write to: no link is followed."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from asia.errors import UserError

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def write_file(folder: Path, name: str, content: str | bytes, mode: int = 0o644) -> None:
    """Replace the file `name`, which may lie in folders below `folder`; those are made. An
    obstacle, such as a link in place of a folder, is moved aside.

    Raises:
        UserError: the file cannot be written.
    """
    *places, last = name.split("/")
    try:
        here = os.open(folder, _FOLDER)
        try:
            for place in places:
                below = _enter(here, place)
                os.close(here)
                here = below
            data = content.encode("utf-8", "replace") if isinstance(content, str) else content
            _replace(here, last, data, mode)
        finally:
            os.close(here)
    except OSError as error:
        raise UserError(
            f"{folder / name} could not be written ({error.strerror}): expected a file, and "
            "no link, in a folder that you may write; remove what is there"
        ) from None


def _enter(here: int, name: str) -> int:
    """The folder `name`, made where it is not there."""
    with contextlib.suppress(FileExistsError):
        os.mkdir(name, dir_fd=here)
    try:
        return os.open(name, _FOLDER, dir_fd=here)
    except OSError:
        _move_away(here, name)
        os.mkdir(name, dir_fd=here)
        return os.open(name, _FOLDER, dir_fd=here)


def _replace(here: int, name: str, data: bytes, mode: int) -> None:
    temporary = f".{name}.{secrets.token_hex(8)}"
    with open(os.open(temporary, _NEW, mode, dir_fd=here), "wb") as stream:
        os.fchmod(stream.fileno(), mode)
        stream.write(data)
    try:
        os.rename(temporary, name, src_dir_fd=here, dst_dir_fd=here)
    except IsADirectoryError:
        _move_away(here, name)
        os.rename(temporary, name, src_dir_fd=here, dst_dir_fd=here)


def _move_away(here: int, name: str) -> None:
    os.rename(name, f".{name}.{secrets.token_hex(8)}", src_dir_fd=here, dst_dir_fd=here)
