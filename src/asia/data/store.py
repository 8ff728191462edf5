"""Test records encrypted at rest: one file in the problem's directory, its key in another folder.

The first line is JSON that anyone may read: the facts about the test that the search needs before
it is opened. The rest is a Fernet token (https://github.com/fernet/spec: AES-128-CBC, then
HMAC-SHA256) of that line without `payload_sha256` and the files, concatenated. A store has a key of
its own.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, with_config

from asia._files import config_folder, sync_folder
from asia.errors import UserError

if TYPE_CHECKING:
    from cryptography.fernet import Fernet

KEYS_VARIABLE = "ASIA_KEYS"
SUFFIX = ".sealed"
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
KeyName = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]


@with_config(_STRICT)
@dataclass(frozen=True)
class SealedFile:
    """One record: its file's name, size in bytes, and number of samples."""

    name: Annotated[str, Field(pattern=r"^[^/\x00]+$")]
    bytes: Annotated[int, Field(gt=0)]
    samples: Annotated[int, Field(gt=0)]


@with_config(_STRICT)
@dataclass(frozen=True)
class SealHead:
    """Public header of a store, readable without its key.

    Attributes:
        sha256: digest of the records, as in a ledger
        inputs, outputs, sampling_time: signals and sampling time (s) used to read them
        shared_samples: samples that also occurred in the training records at sealing
        outside_inputs: for each input, samples beyond the range of the training records
        payload_sha256: digest of the encrypted payload, "" inside it
    """

    key: KeyName
    sha256: Digest
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: Annotated[float, Field(gt=0)]
    files: Annotated[tuple[SealedFile, ...], Field(min_length=1)]
    shared_samples: Annotated[int, Field(ge=0)]
    outside_inputs: tuple[Annotated[int, Field(ge=0)], ...] = ()
    payload_sha256: Digest | Literal[""] = ""
    format: Literal["asia-sealed-1"] = "asia-sealed-1"


@dataclass(frozen=True)
class PlainFile:
    """A file in memory."""

    name: str
    data: bytes


def key_folder(given: Path | None = None) -> Path:
    """Return the folder of keys: `given`, else $ASIA_KEYS, else asia/keys in $XDG_CONFIG_HOME or
    ~/.config."""
    if given is not None:
        return given.absolute()
    named = os.environ.get(KEYS_VARIABLE)
    if named:
        return Path(named).absolute()
    return config_folder() / "keys"


def new_key(folder: Path) -> str:
    """Make a key and return its name; on return FOLDER/NAME.key is on the disk, for its owner
    alone. Raises UserError when it cannot be written."""
    from cryptography.fernet import Fernet

    secret = Fernet.generate_key()
    name = _key_name(secret)
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        path = key_path(folder, name)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with open(fd, "wb") as stream:
            stream.write(secret + b"\n")
            stream.flush()
            os.fsync(stream.fileno())
        sync_folder(folder)
    except OSError as error:
        raise UserError(
            f"cannot write a key below {folder} ({error.strerror}): name a folder of yours with "
            f"--keys or {KEYS_VARIABLE}"
        ) from None
    return name


def key_path(folder: Path, name: str) -> Path:
    """Return the path of the key with this name."""
    return folder / f"{name}.key"


def write_store(path: Path, head: SealHead, contents: Sequence[PlainFile], keys: Path) -> None:
    """Encrypt `contents`, the files of `head`, with its key; on return the store is on the disk.

    Raises:
        UserError: without the key
        OSError: when the store cannot be written
    """
    plain = _line(head) + b"\n" + b"".join(content.data for content in contents)
    payload = _fernet(head, path, keys).encrypt(plain)
    public = replace(head, payload_sha256=hashlib.sha256(payload).hexdigest())
    with path.open("xb") as stream:
        stream.write(_line(public) + b"\n" + payload)
        stream.flush()
        os.fsync(stream.fileno())


def read_seal(path: Path) -> SealHead:
    """Read the public header of the store at `path`, without its key. Raises UserError when it is
    not a store or was damaged."""
    return _split(path)[0]


def find_key(path: Path, head: SealHead, keys: Path) -> None:
    """Check that the key of a store can be used. Raises UserError with the remedy, when it
    cannot."""
    _fernet(head, path, keys)


def open_store(path: Path, keys: Path) -> tuple[PlainFile, ...]:
    """The files of a store. Raises UserError without the key, or when the store was changed."""
    from cryptography.fernet import InvalidToken

    head, payload = _split(path)
    fernet = _fernet(head, path, keys)
    try:
        line, _, plain = fernet.decrypt(payload).partition(b"\n")
    except InvalidToken:
        line, plain = b"", b""
    size = sum(file.bytes for file in head.files)
    if line != _line(replace(head, payload_sha256="")) or len(plain) != size:
        raise UserError(f"{path} was changed after it was sealed: bring the one that was sealed")
    content = io.BytesIO(plain)
    return tuple(PlainFile(file.name, content.read(file.bytes)) for file in head.files)


def _split(path: Path) -> tuple[SealHead, bytes]:
    try:
        with path.open("rb") as stream:
            line = stream.readline(1_000_000)
            payload = stream.read()
    except OSError as error:
        raise UserError(f"cannot read the sealed test {path}: {error.strerror}") from error
    try:
        head = TypeAdapter(SealHead).validate_json(line)
    except ValidationError:
        raise UserError(
            f"{path} is not a sealed test, or one of another version: expected a file that asia "
            "init --seal wrote"
        ) from None
    if hashlib.sha256(payload).hexdigest() != head.payload_sha256:
        raise UserError(f"{path} is damaged: bring the one that asia init --seal wrote")
    return head, payload


def _fernet(head: SealHead, path: Path, keys: Path) -> Fernet:
    from cryptography.fernet import Fernet

    place = key_path(keys, head.key)
    try:
        secret = place.read_bytes().strip()
    except FileNotFoundError:
        raise UserError(
            f"the key of {path} is not on this machine: bring {place.name} from where the test was "
            f"sealed into {keys}, or name its folder with --keys or {KEYS_VARIABLE}; if it is "
            "lost, nobody can open this test"
        ) from None
    except OSError as error:
        raise UserError(f"cannot read the key {place}: {error.strerror}") from error
    if _key_name(secret) != head.key:
        raise UserError(f"{place} is damaged: bring the key that asia init --seal wrote")
    return Fernet(secret)


def _key_name(secret: bytes) -> str:
    return hashlib.sha256(secret).hexdigest()[:16]


def _line(head: SealHead) -> bytes:
    return json.dumps(asdict(head), ensure_ascii=False, separators=(",", ":")).encode()
