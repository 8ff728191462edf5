"""Files that appear whole or not at all, and what to say where the disk refuses."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections.abc import Generator
from pathlib import Path

from asia._files import sync_folder
from asia.errors import UserError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Turns an OSError into a UserError that names `path` and says what to do."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{path} could not be written: {_message(error)}") from None


def _message(error: OSError) -> str:
    if error.errno in _FULL:
        return (
            f"the disk is full ({error.strerror}); recorded events are safe: free some space and "
            f"repeat the command"
        )
    if error.errno == errno.EFBIG:
        return (
            "the file would exceed the limit of file sizes; recorded events are safe: raise it "
            "(ulimit -f) and repeat the command"
        )
    if error.errno in _FORBIDDEN:
        return f"{error.strerror}; make the directory writable, or name another one with --runs"
    return (
        f"{error.strerror or error}; recorded events are safe: correct this and repeat the command"
    )


def write_whole(path: Path, data: bytes, *, durable: bool = True) -> None:
    """The file appears with all its bytes in one step; `durable`: on return it is on the disk.
    Missing folders are made. Raises UserError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_native_id()}.new")
    with writing(path):
        make_folder(path.parent)
        try:
            with temporary.open("wb") as stream:
                stream.write(data)
                if durable:
                    stream.flush()
                    os.fsync(stream.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        if durable:
            sync_folder(path.parent)


def make_folder(path: Path) -> None:
    """Create a folder with its parents. A new folder is on the disk on return."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(exist_ok=True)
        sync_folder(path.parent)
