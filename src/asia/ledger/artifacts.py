"""Content-addressed artifacts: store and verification."""

import hashlib
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

from asia._files import open_ordinary
from asia.errors import UserError
from asia.judge.artifacts import ArtifactStore
from asia.ledger.chain import write_whole, writing

MOST_BYTES = 1 << 30
"""Largest artifact that is read."""


def without_artifacts(directory: Path) -> str:
    """Describe the use of a run directory without artifacts."""
    return (
        f"{directory} has a ledger without artifacts, but this needs sources, models or "
        f"simulations: restore the folder artifacts. asia status, show, report and verify work "
        f"without it"
    )


class Store(ArtifactStore):
    """`<run>/artifacts/<sha256>`; written and synced before a record names it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    @property
    def kept(self) -> bool:
        """Return whether there are artifacts at all; a ledger may be published without them."""
        return self._directory.is_dir()

    def put(self, data: bytes) -> str:
        """Keep `data`; its sha256. Raises UserError when the disk refuses."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._directory / digest
        if not path.exists():
            write_whole(path, data)
        return digest

    def tidy(self) -> None:
        """Remove what a killed process had begun to write; for the one that holds the ledger."""
        with writing(self._directory):
            for path in self._directory.glob(".*.new"):
                path.unlink()

    def get(self, digest: str) -> bytes:
        """The bytes of an artifact. Raises UserError when it is gone or changed."""
        path = f"{self._directory}/{digest}"
        try:
            data = _read(path)
        except OSError as error:
            if not self.kept:
                raise UserError(without_artifacts(self._directory.parent)) from None
            how = "is missing" if isinstance(error, FileNotFoundError) else "cannot be read"
            raise UserError(f"artifact {path} {how} ({error.strerror})") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise UserError(f"artifact {path} was changed after it was written")
        return data

    def text(self, digest: str) -> str:
        """A source or a printed output. Raises UserError as `get`, and for other bytes."""
        try:
            return self.get(digest).decode()
        except UnicodeDecodeError:
            raise UserError(f"artifact {digest} is not text") from None


def _read(path: str) -> bytes:
    """Read a file in half the time of `Path.read_bytes`: a long search has a million small ones."""
    most = 64 * 1024
    fd = open_ordinary(path, MOST_BYTES)
    try:
        parts = [os.read(fd, most)]
        while len(parts[-1]) == most:
            parts.append(os.read(fd, most))
    finally:
        os.close(fd)
    return parts[0] if len(parts) == 1 else b"".join(parts)


# Verification of all artifacts that a ledger names, on all cores. A long search has a million of
# them.


_BATCH = 512
# Reads names on stdin; ends with 1 at the first file whose sha256 is not its name, or that is gone.
_HELPER = """
import hashlib, os, stat, sys
os.chdir(sys.argv[1])
for line in sys.stdin:
    if not stat.S_ISREG(os.lstat(line[:-1]).st_mode):
        sys.exit(1)
    fd = os.open(line[:-1], os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    if os.fstat(fd).st_size > int(sys.argv[2]):
        sys.exit(1)
    part = os.read(fd, 65536)
    digest = hashlib.sha256(part)
    while len(part) == 65536:
        part = os.read(fd, 65536)
        digest.update(part)
    os.close(fd)
    if digest.hexdigest() != line[:-1]:
        sys.exit(1)
"""


class Artifacts:
    """The artifacts named so far. Few are checked here, many by processes that end with this."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._records: dict[str, int] = {}
        self._batch: list[str] = []
        self._helpers: list[subprocess.Popen[str]] = []
        self._batches = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        for helper in self._helpers:
            helper.kill()
            helper.communicate()

    def __len__(self) -> int:
        return len(self._records)

    def add(self, digest: str, record: int) -> None:
        """`record` names an artifact."""
        if digest in self._records:
            return
        self._records[digest] = record
        self._batch.append(digest)
        if len(self._batch) < _BATCH:
            return
        if not self._helpers:
            # The pipe is large enough that no helper idles while the reader waits for another.
            self._helpers = [
                subprocess.Popen(
                    [
                        sys.executable, "-I", "-S", "-c", _HELPER, str(self._directory),
                        str(MOST_BYTES),
                    ],
                    stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, pipesize=1 << 20,
                )
                for _ in range(os.cpu_count() or 1)
            ]  # fmt: skip
        stdin = self._helpers[self._batches % len(self._helpers)].stdin
        assert stdin is not None
        # One that found something has ended; its exit code says so later.
        with suppress(BrokenPipeError):
            stdin.write("".join(f"{digest}\n" for digest in self._batch))
        self._batches += 1
        self._batch = []

    def check(self) -> None:
        """Raises UserError that names the first record one of whose artifacts does not hold."""
        for helper in self._helpers:
            with suppress(BrokenPipeError):
                helper.communicate()
        sound = all(helper.returncode == 0 for helper in self._helpers)
        store = Store(self._directory)
        for digest in self._batch if sound else self._records:
            try:
                store.get(digest)
            except UserError as error:
                where = f"event {self._records[digest]} of {self._directory.parent}"
                raise UserError(f"{where}: {error}") from None
