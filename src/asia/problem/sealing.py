"""Moving test records into an encrypted store."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from asia._files import read_file, sync_folder
from asia.data.intake.sheet import Wanted
from asia.data.relations import samples_outside, shared_samples
from asia.data.sources.sealed import sealed_record
from asia.data.store import (
    SUFFIX,
    PlainFile,
    SealedFile,
    SealHead,
    key_path,
    new_key,
    open_store,
    write_store,
)
from asia.data.trajectory import Trajectory, data_digest
from asia.errors import UserError
from asia.problem.toml import toml_value

STORE = f"test{SUFFIX}"


@dataclass(frozen=True)
class Columns:
    """Columns of a record: names, and sampling time in seconds."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: float

    def read(self, content: PlainFile) -> Trajectory:
        """Raise UserError."""
        return sealed_record(content, Wanted(self.inputs, self.outputs), self.sampling_time)


@dataclass(frozen=True)
class Sealing:
    """Records to seal.

    Attributes:
        originals: plain files to remove after sealing, in the order of `contents`; none where
            the rows came out of files that stay
    """

    columns: Columns
    contents: tuple[PlainFile, ...]
    originals: tuple[Path, ...] = ()

    @property
    def records(self) -> tuple[Trajectory, ...]:
        """Records in the files.

        Raises:
            UserError: when they cannot be read
        """
        return tuple(self.columns.read(content) for content in self.contents)

    def toml(self) -> str:
        """The entry of [data]."""
        entry = {"file": STORE, "sha256": data_digest(self.records)}
        return (
            "# The test records, encrypted; sha256 is the digest of their values. The key is kept\n"
            "# elsewhere, and asia unseal opens them once, at the end.\n"
            f"sealed = {toml_value(entry)}\n"
        )

    def write(self, folder: Path, train: Sequence[Trajectory], keys: Path) -> Path:
        """Make a key and, in `folder`, the store; on return both are on the disk.

        A failure leaves no key behind.

        Returns:
            the path of the key

        Raises:
            UserError, OSError: when they cannot be written
        """
        records, columns = self.records, self.columns
        name = new_key(keys)
        head = SealHead(
            key=name,
            sha256=data_digest(records),
            inputs=columns.inputs,
            outputs=columns.outputs,
            sampling_time=float(columns.sampling_time),
            files=tuple(
                SealedFile(content.name, len(content.data), len(record))
                for content, record in zip(self.contents, records, strict=True)
            ),
            shared_samples=shared_samples(records, train),
            outside_inputs=samples_outside(records, train),
        )
        key = key_path(keys, name)
        try:
            write_store(folder / STORE, head, self.contents, keys)
            sync_folder(folder)
        except BaseException:
            key.unlink(missing_ok=True)
            raise
        return key


def seal_files(paths: Sequence[Path], columns: Columns) -> Sealing:
    """Return the files as content to seal.

    Raises:
        UserError: for a file that cannot be moved or read
    """
    for path in paths:
        if path.is_symlink():
            raise UserError(
                f"{path} is a link, and sealing would leave the file behind it: give "
                f"{path.resolve()} itself"
            )
    names = Counter(path.name for path in paths)
    contents = tuple(
        PlainFile(
            path.name if names[path.name] == 1 else f"{path.resolve().parent.name}_{path.name}",
            read_file(path, "name a file"),
        )
        for path in paths
    )
    return Sealing(columns, contents, tuple(path.resolve() for path in paths))


def check_key_folder(keys: Path, directory: Path) -> None:
    """Raise UserError when the key would lie in the directory of its store."""
    real = keys.resolve()
    if real == directory or directory in real.parents:
        raise UserError(
            f"the keys in {keys} would be in the problem's directory, beside the data that "
            "they open: give another folder with --keys or ASIA_KEYS"
        )


def remove_plain(
    sealing: Sealing, store: Path, keys: Path
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Remove the plain files, once the store was read back and holds the same bytes.

    Returns:
        the removed files, and messages about those and about others

    Raises:
        UserError: with all files still there, when it does not
    """
    if open_store(store, keys) != sealing.contents:
        raise UserError(f"{store} does not hold what was sealed: the plain files were left alone")
    removed: list[Path] = []
    notes: list[str] = []
    own = os.environ.get("ASIA_DATA_DIR")
    downloads = [Path.home() / name for name in (".nonlinear_benchmarks", ".asia")]
    downloads = [folder.resolve() for folder in (*([Path(own)] if own else []), *downloads)]
    for path, content in zip(sealing.originals, sealing.contents, strict=False):
        if any(folder in path.parents for folder in downloads):
            notes.append(
                f"the plain file {path} belongs to a download and stays, for others read it from "
                "there: the store hides nothing that is not public"
            )
            continue
        if read_file(path, "name a file") != content.data:
            notes.append(
                f"the plain file {path} changed while it was sealed and stays: compare it with "
                "your original"
            )
            continue
        # Other places where the rows may still exist.
        if path.stat().st_nlink > 1:
            notes.append(f"{path} has other names on this disk (hard links), which still hold it")
        if any((folder / ".git").exists() for folder in path.parents):
            notes.append(f"{path} lies in a git repository, whose history may still hold it")
        try:
            path.unlink()
            sync_folder(path.parent)
        except OSError as error:
            notes.append(
                f"the plain file {path} could not be removed ({error.strerror}): remove it yourself"
            )
        else:
            removed.append(path)
    return tuple(removed), tuple(notes)
