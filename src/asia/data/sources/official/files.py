"""Published files on this machine: where they lie, whether they are the published ones."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import urllib.request
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from asia.errors import UserError

_TIMEOUT_S = 60.0
_CHUNK = 1 << 20
# How a file begins that git-lfs has not fetched: https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md
_POINTER = b"version https://git-lfs"


@dataclass(frozen=True)
class PublishedFile:
    """One file of a benchmark."""

    path: str
    """Path in the folder of its benchmark."""
    sha256: str = ""
    """Digest, or its first and last digits with `...` between them; "" where none is known."""
    url: str = ""
    """Address of the download; "" where a download cannot be verified."""
    zipped: bool = False
    """Whether `url` is a zip archive that holds `path`; its records have a digest then."""

    def __post_init__(self) -> None:
        assert not self.url or self.zipped or re.fullmatch("[0-9a-f]{64}", self.sha256)

    def is_digest(self, found: str) -> bool:
        """Return whether `found` can be the digest of this file."""
        first, _, last = self.sha256.partition("...")
        return found.startswith(first) and found.endswith(last)


def benchmark_folder(name: str, paths: Sequence[str]) -> Path:
    """The folder of a benchmark: in $ASIA_DATA_DIR/nonlinear_benchmarks when one of its files is
    there, else in ~/.nonlinear_benchmarks, as the package nonlinear-benchmarks has it."""
    own = os.environ.get("ASIA_DATA_DIR")
    if own:
        folder = Path(own) / "nonlinear_benchmarks" / name
        if any((folder / path).is_file() for path in paths):
            return folder
    return Path.home() / ".nonlinear_benchmarks" / name


def check_files(
    name: str, folder: Path, files: Sequence[PublishedFile], page: str
) -> tuple[str, ...]:
    """Check the files of a benchmark against their published digests.

    A missing file is downloaded where the download can be verified.

    Returns:
        warnings about files that may not be the published ones

    Raises:
        UserError: for a file that is missing, that git-lfs has not fetched, or that has another
            digest than the published one
    """
    missing = [file for file in files if not (folder / file.path).is_file()]
    for file in missing:
        problem = "no download of it is pinned by a digest"
        if file.url:
            problem = _download(file, folder / file.path)
        if problem:
            raise UserError(_how_to_get(name, file, folder, page, problem))
    unknown = [line for file in files for line in _check(file, folder / file.path)]
    if not unknown:
        return ()
    return (
        f"no published digest of these files of {name} is known: compare their sha256 with those "
        f"of somebody who has them, or make sure where yours came from: {', '.join(unknown)}",
    )


def _check(file: PublishedFile, path: Path) -> tuple[str, ...]:
    """Path and digest of a file whose published digest is not known. Raises UserError."""
    with path.open("rb") as stream:
        if stream.read(len(_POINTER)) == _POINTER:
            raise UserError(
                f"{path} is a pointer of git-lfs and not the file itself: install git-lfs, run git "
                "lfs pull in the clone it came from, and copy it again"
            )
    found = _sha256(path)
    if not file.sha256:
        return (f"{file.path} {found}",)
    if not file.is_digest(found):
        raise UserError(
            f"{path} is not the published file (sha256 {found[:12]}..., expected "
            f"{file.sha256[:8]}...): remove it and get it again, over a network you trust"
        )
    return ()


def _sha256(path: Path) -> str:
    state = path.stat()
    return _sha256_of(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=64)
def _sha256_of(path: Path, changed: int, size: int) -> str:
    """Read once for each state of the file."""
    del changed, size
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_CHUNK):
            digest.update(block)
    return digest.hexdigest()


def _download(file: PublishedFile, path: Path) -> str:
    """Download a file to `path` if its digest matches; else return the reason."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(dir=path.parent) as folder,
            urllib.request.urlopen(file.url, timeout=_TIMEOUT_S) as answer,
        ):
            arrived = Path(folder) / path.name
            with arrived.open("wb") as target:
                shutil.copyfileobj(answer, target, _CHUNK)
            if file.zipped:
                with zipfile.ZipFile(arrived) as archive:
                    arrived = Path(archive.extract(file.path, folder))
            elif _sha256(arrived) != file.sha256:
                return f"{file.url} holds other bytes than those published"
            arrived.replace(path)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        return f"the download failed ({error})"
    return ""


def _how_to_get(name: str, file: PublishedFile, folder: Path, page: str, problem: str) -> str:
    return (
        f"the data of benchmark {name} are not on this machine, for {file.path} is missing and "
        f"{problem}: get it from {page} and put it, unpacked, at "
        f"$ASIA_DATA_DIR/nonlinear_benchmarks/{folder.name}/{file.path} with ASIA_DATA_DIR set to "
        f"a folder of yours (or at {folder / file.path})"
    )
