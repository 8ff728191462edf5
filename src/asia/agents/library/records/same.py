"""Records as a key: the same objects, whatever they hold."""

from __future__ import annotations

from collections.abc import Sequence

from asia.data import Trajectory


class SameRecords:
    """Key that is equal for the identical record objects, to reuse their analysis."""

    def __init__(self, records: Sequence[Trajectory]) -> None:
        self.records = tuple(records)

    def __hash__(self) -> int:
        return hash(tuple(map(id, self.records)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SameRecords) and (
            len(self.records) == len(other.records)
            and all(a is b for a, b in zip(self.records, other.records, strict=True))
        )
