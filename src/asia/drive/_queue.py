"""Candidates handed in from outside: files in the run directory, so that none is lost when a
process dies, and any process can hand one in."""

from __future__ import annotations

import fcntl
import json
import os
import re
import secrets
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from pydantic import TypeAdapter

from asia.agents import Proposal
from asia.errors import UserError
from asia.ledger import write_whole

TITLE = 80
TEXT = 2000

# A ticket comes back from outside and is part of a file name.
_TICKET = re.compile(r"\d{20}-[0-9a-f]{8}")
_WAITING, _TAKEN = ".json", ".taken"
_proposals = TypeAdapter(Proposal)


@dataclass(frozen=True)
class Queue:
    """The `control/queue` folder of a run directory.

    TICKET.json waits; it becomes TICKET.taken when the search is about to record it, and is removed
    once the ledger has it.
    """

    directory: Path

    @property
    def folder(self) -> Path:
        """Folder of the queue."""
        return self.directory / "control" / "queue"

    @contextmanager
    def alone(self) -> Generator[None]:
        """Hold the lock for one submission at a time."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("wb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield

    def put(self, proposal: Proposal) -> str:
        """Hand in; on return it is on the disk. The ticket, which comes after all that wait: a
        clock may be set back."""
        newest = max((int(t[:20]) for t in self.tickets()), default=-1)
        ticket = f"{max(time.time_ns(), newest + 1):020d}-{secrets.token_hex(4)}"
        body = json.dumps(asdict(replace(proposal, ticket=ticket)))
        write_whole(self._path(ticket), body.encode())
        return ticket

    def tickets(self) -> list[str]:
        """Return the submissions that are not in the ledger yet, oldest first."""
        return sorted({*self._names(_WAITING), *self._names(_TAKEN)})

    def get(self, ticket: str) -> Proposal | None:
        """The submission; None when it was withdrawn or recorded meanwhile. Raises UserError for a
        file that is none."""
        for suffix in (_WAITING, _TAKEN) if _TICKET.fullmatch(ticket) else ():
            path = self._path(ticket, suffix)
            try:
                return _proposals.validate_json(path.read_bytes(), strict=True)
            except FileNotFoundError:
                continue
            except ValueError:
                raise UserError(f"{path} is not a submission: remove the file") from None
        return None

    def take(self) -> Proposal | None:
        """The oldest that waits; from here on it cannot be withdrawn, and it stays until it is
        removed. None when nothing waits."""
        for ticket in sorted(self._names(_WAITING)):
            try:
                self._path(ticket).replace(self._path(ticket, _TAKEN))
            except FileNotFoundError:
                continue
            return self.get(ticket)
        return None

    def give_back(self) -> None:
        """Return taken submissions to the queue: their search ended before it recorded them."""
        for ticket in self._names(_TAKEN):
            self._path(ticket, _TAKEN).replace(self._path(ticket))

    def withdraw(self, ticket: str) -> bool:
        """Take back; False when it does not wait, or not any more."""
        return ticket in self._names(_WAITING) and _unlinked(self._path(ticket))

    def remove(self, ticket: str) -> bool:
        """Take out once it is in the ledger; whether it was there."""
        if not _TICKET.fullmatch(ticket):
            return False
        return any(_unlinked(self._path(ticket, s)) for s in (_WAITING, _TAKEN))

    def _path(self, ticket: str, suffix: str = _WAITING) -> Path:
        return self.folder / f"{ticket}{suffix}"

    def _names(self, suffix: str) -> list[str]:
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return []
        found = (name.removesuffix(suffix) for name in names if name.endswith(suffix))
        return [name for name in found if _TICKET.fullmatch(name)]


def _unlinked(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True
