"""Verification of all artifacts that a ledger names, on all cores. A long search has a million of
them.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Self

from asia.errors import UserError
from asia.ledger._store import Store

_BATCH = 512
_PIPE_BYTES = 1 << 20  # large enough that no helper idles while the reader waits for another
# Reads names on stdin; ends with 1 at the first file whose sha256 is not its name, or that is gone.
_HELPER = """
import hashlib, os, sys
os.chdir(sys.argv[1])
for line in sys.stdin:
    fd = os.open(line[:-1], os.O_RDONLY)
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
        if len(self._batch) == _BATCH:
            self._hand_out()

    def check(self) -> None:
        """Raises UserError that names the first record one of whose artifacts does not hold."""
        sound = not [1 for helper in self._helpers if _ended(helper)]
        store = Store(self._directory)
        for digest in self._batch if sound else self._records:
            try:
                store.get(digest)
            except UserError as error:
                where = f"event {self._records[digest]} of {self._directory.parent}"
                raise UserError(f"{where}: {error}") from None

    def _hand_out(self) -> None:
        if not self._helpers:
            self._helpers = [_helper(self._directory) for _ in range(os.cpu_count() or 1)]
        stdin = self._helpers[self._batches % len(self._helpers)].stdin
        assert stdin is not None
        # One that found something has ended; its exit code says so later.
        with suppress(BrokenPipeError):
            stdin.write("".join(f"{digest}\n" for digest in self._batch))
        self._batches += 1
        self._batch = []


def _helper(directory: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", _HELPER, str(directory)],
        stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, pipesize=_PIPE_BYTES,
    )  # fmt: skip


def _ended(helper: subprocess.Popen[str]) -> int:
    with suppress(BrokenPipeError):
        helper.communicate()
    return helper.returncode
