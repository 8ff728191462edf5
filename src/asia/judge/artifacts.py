"""Artifacts: the large parts of records, under the sha256 of their bytes."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from pydantic import TypeAdapter

from asia.data.trajectory import Array
from asia.errors import UserError

ArtifactName = str
"""sha256 of an artifact."""
T = TypeVar("T")


class ArtifactStore:
    """Artifacts in memory."""

    def __init__(self) -> None:
        self._bytes: dict[ArtifactName, bytes] = {}

    def put(self, data: bytes) -> ArtifactName:
        """Keep `data` and return its name."""
        name = hashlib.sha256(data).hexdigest()
        self._bytes[name] = data
        return name

    def get(self, digest: ArtifactName) -> bytes:
        """Return the bytes of an artifact."""
        return self._bytes[digest]

    def put_arrays(self, arrays: Sequence[Array]) -> ArtifactName:
        """Raw little-endian float64, one array after the other."""
        return self.put(b"".join(np.ascontiguousarray(a, "<f8").tobytes() for a in arrays))

    def get_arrays(
        self, digest: ArtifactName, shapes: Sequence[tuple[int, ...]]
    ) -> tuple[Array, ...]:
        """The arrays of `put_arrays`, whose shapes the caller knows."""
        flat = np.frombuffer(self.get(digest), "<f8")
        ends = np.cumsum([int(np.prod(s)) for s in shapes])
        if len(ends) == 0 or ends[-1] != len(flat):
            raise UserError(f"artifact {digest} has {len(flat)} numbers, expected {shapes}")
        return tuple(
            part.reshape(shape)
            for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
        )

    def parse(
        self, digest: ArtifactName, form: TypeAdapter[T], known: Mapping[str, object] | None = None
    ) -> T:
        """Parse an artifact of JSON; known: fields that take the place of its own. Raises UserError
        where it is missing or this version cannot read it."""
        try:
            data = self.get(digest)
            if known is not None:
                data = json.dumps({**json.loads(data), **known})
            return form.validate_json(data)
        except (ValueError, TypeError):
            raise UserError(
                f"artifact {digest} was written by another version of ASIA: read it with that one"
            ) from None
