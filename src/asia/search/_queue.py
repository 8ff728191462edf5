"""Candidates handed in from outside: files in the run directory, so that none is lost when a
process dies, and any process can hand one in."""

from __future__ import annotations

import json
import os
import secrets
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from asia.agents import Proposal
from asia.search._controls import write_whole

TITLE = 80
TEXT = 2000


@dataclass(frozen=True)
class Queue:
    """The `control/queue` folder of a run directory."""

    directory: Path

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self.directory / "control" / "queue"

    def put(self, proposal: Proposal) -> str:
        """Hand in; on return it is on the disk. The ticket."""
        ticket = f"{time.time_ns():020d}-{secrets.token_hex(4)}"
        body = json.dumps({**asdict(proposal), "ticket": ticket})
        write_whole(self.folder / f"{ticket}.json", body.encode())
        return ticket

    def tickets(self) -> list[str]:
        """What waits, oldest first."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return []
        return sorted(n[:-5] for n in names if n.endswith(".json") and not n.startswith("."))

    def get(self, ticket: str) -> Proposal | None:
        """The submission; None when it was withdrawn meanwhile."""
        try:
            raw = json.loads((self.folder / f"{ticket}.json").read_text("utf-8"))
        except FileNotFoundError:
            return None
        return Proposal(**raw)

    def remove(self, ticket: str) -> bool:
        """Withdraw, or take out once it is in the ledger; whether it was there."""
        try:
            (self.folder / f"{ticket}.json").unlink()
        except FileNotFoundError:
            return False
        return True
