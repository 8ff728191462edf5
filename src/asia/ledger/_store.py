"""Content-addressed artifacts: sources, models, simulations."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asia.errors import UserError
from asia.problem import Array


class Store:
    """`<run>/artifacts/<sha256>`; written and synced before a record names it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def put(self, data: bytes) -> str:
        """Keep `data`; its sha256."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._directory / digest
        if path.exists():
            return digest
        self._directory.mkdir(parents=True, exist_ok=True)
        temporary = self._directory / f".{digest}.{os.getpid()}"
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
        directory = os.open(self._directory, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
        return digest

    def get(self, digest: str) -> bytes:
        """The bytes of an artifact. Raises UserError when it is gone or changed."""
        path = self._directory / digest
        try:
            data = path.read_bytes()
        except OSError:
            raise UserError(f"artifact {path} is missing") from None
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
