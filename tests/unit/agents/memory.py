"""A journal in memory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

from asia.ledger.events import Event, Exchanged


@dataclass
class MemoryJournal:
    experiments: int = 1
    events: list[Event] = field(default_factory=list)
    blobs: dict[str, bytes] = field(default_factory=dict)
    interrupt: bool = False

    @property
    def exchanges(self) -> tuple[Exchanged, ...]:
        return tuple(e for e in self.events if isinstance(e, Exchanged))

    def record(self, event: Event) -> None:
        self.events.append(event)

    def put(self, data: bytes) -> str:
        name = hashlib.sha256(data).hexdigest()
        self.blobs[name] = data
        return name

    def get(self, name: str) -> bytes:
        return self.blobs[name]

    def interrupted(self) -> bool:
        return self.interrupt
