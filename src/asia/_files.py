"""Files that a user names or somebody else made, with clear errors for anything but ordinary files;
files of the user that others must not read; folders that are safely on the disk."""

import contextlib
import errno
import hashlib
import os
import secrets
import stat
from pathlib import Path

from asia.errors import UserError

PACKAGE = Path(__file__).parent
"""Folder of this package, with the files that it brings."""

MOST_BYTES = 4 << 30
"""Largest file that is read at once."""

_KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFREG: "a file",
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
            found = os.fstat(fd)
            _check_ordinary(path, found.st_mode, remedy)
            if found.st_size > MOST_BYTES:
                raise UserError(
                    f"cannot read {path}: it has {found.st_size / 2**30:.0f} GiB, at most "
                    f"{MOST_BYTES >> 30} are read; {remedy}"
                )
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
        raise UserError(
            f"cannot read {path}: it is {kind_of(mode)}, not an ordinary file; {remedy}"
        )


def kind_of(mode: int) -> str:
    """Return the kind of a file with this mode in words."""
    return _KINDS.get(stat.S_IFMT(mode), "no file")


def open_ordinary(path: Path | str, most: int | None = None) -> int:
    """Open an ordinary file for reading. Follows no link at the end of the path, waits for no named
    pipe, opens no device.

    Args:
        most: largest size in bytes; None for any.

    Raises:
        OSError: it cannot be opened, is something else, or is larger.
    """
    # Looked at before it is opened, for opening a device can do something by itself.
    _refuse_others(os.lstat(path), most)
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_others(os.fstat(fd), most)
    except OSError:
        os.close(fd)
        raise
    return fd


def _refuse_others(found: os.stat_result, most: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, f"it is {kind_of(found.st_mode)}, not an ordinary file")
    if most is not None and found.st_size > most:
        raise OSError(errno.EFBIG, f"it has {found.st_size} bytes, at most {most} are read")


# Safe writing into a folder that other processes may write to: no link is followed.


_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def write_file(folder: Path, name: str, content: str | bytes, mode: int = 0o644) -> None:
    """Replace the file `name`, which may lie in folders below `folder`; those are made. An
    obstacle, such as a link in place of a folder, is moved aside. Raises UserError when the file
    cannot be written."""
    *places, last = name.split("/")
    data = content.encode("utf-8", "replace") if isinstance(content, str) else content
    temporary = f".{last}.{secrets.token_hex(8)}"
    try:
        here = os.open(folder, _FOLDER)
        try:
            for place in places:
                below = _enter(here, place)
                os.close(here)
                here = below
            with open(os.open(temporary, _NEW, mode, dir_fd=here), "wb") as stream:
                os.fchmod(stream.fileno(), mode)
                stream.write(data)
            try:
                os.rename(temporary, last, src_dir_fd=here, dst_dir_fd=here)
            except IsADirectoryError:
                _move_away(here, last)
                os.rename(temporary, last, src_dir_fd=here, dst_dir_fd=here)
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


def _move_away(here: int, name: str) -> None:
    os.rename(name, f".{name}.{secrets.token_hex(8)}", src_dir_fd=here, dst_dir_fd=here)


# Files of the user that no agent in a jail, no other user and no received folder can bring.


def config_folder() -> Path:
    """Return asia in $XDG_CONFIG_HOME or ~/.config."""
    return _home("XDG_CONFIG_HOME", ".config")


def cache_folder() -> Path:
    """Return asia in $XDG_CACHE_HOME or ~/.cache."""
    return _home("XDG_CACHE_HOME", ".cache")


def _home(variable: str, default: str) -> Path:
    named = os.environ.get(variable, "")
    return (Path(named) if os.path.isabs(named) else Path.home() / default) / "asia"


def name_of_place(path: Path, *more: object) -> str:
    """Return a file name for the real path of a folder or file, and further values."""
    words = "\0".join(map(str, (path.resolve(), *more)))
    return hashlib.sha256(words.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def read_private(path: Path) -> bytes | None:
    """Return the bytes of a file of `write_private`; None where there is none, or one that another
    user owns or may write."""
    try:
        with open(open_ordinary(path, 1 << 20), "rb") as stream:
            found = os.fstat(stream.fileno())
            own = found.st_uid == os.geteuid() and not found.st_mode & 0o022
            return stream.read() if own else None
    except OSError:
        return None


def write_private(path: Path, data: bytes) -> None:
    """Replace a file in one step, readable for its owner alone. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with open(os.open(temporary, _NEW, 0o600), "wb") as stream:
            stream.write(data)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
