"""Content-addressed artifacts: sources, models, simulations."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asia.data import Array
from asia.errors import UserError
from asia.ledger._disk import write_whole, writing

_PART = 64 * 1024


def without_artifacts(directory: Path) -> str:
    """Describe the use of a run directory without artifacts."""
    return (
        f"{directory} has a ledger without artifacts, but this needs sources, models or "
        f"simulations: restore the folder artifacts. asia status, show, report and verify work "
        f"without it"
    )


class Store:
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
        if path.exists():
            return digest
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
            raise UserError(f"artifact {path} is missing ({error.strerror})") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise UserError(f"artifact {path} was changed after it was written")
        return data

    def text(self, digest: str) -> str:
        """A source or a printed output."""
        return self.get(digest).decode()

    def put_arrays(self, arrays: Sequence[Array]) -> str:
        """Raw little-endian float64, one array after the other."""
        return self.put(b"".join(np.ascontiguousarray(a, "<f8").tobytes() for a in arrays))

    def get_arrays(self, digest: str, shapes: Sequence[tuple[int, ...]]) -> tuple[Array, ...]:
        """The arrays of `put_arrays`, whose shapes the caller knows."""
        flat = np.frombuffer(self.get(digest), "<f8")
        ends = np.cumsum([int(np.prod(s)) for s in shapes])
        if len(ends) == 0 or ends[-1] != len(flat):
            raise UserError(f"artifact {digest} has {len(flat)} numbers, expected {shapes}")
        return tuple(
            part.reshape(shape)
            for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
        )


def _read(path: str) -> bytes:
    """Read a file in half the time of `Path.read_bytes`: a long search has a million small ones."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        parts = [os.read(fd, _PART)]
        while len(parts[-1]) == _PART:
            parts.append(os.read(fd, _PART))
    finally:
        os.close(fd)
    return parts[0] if len(parts) == 1 else b"".join(parts)
