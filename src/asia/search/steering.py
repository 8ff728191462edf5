"""Requests of the user to a running search, as files in its directory, so that any process can make
them.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger.chain import write_whole

LONGEST_NOTE = 4000


@dataclass(frozen=True)
class Steering:
    """The `control` folder of a run directory."""

    directory: Path

    @property
    def folder(self) -> Path:
        """Folder of the request files."""
        return self.directory / "control"

    def steer(self, text: str) -> None:
        """Leave a note for the agent. Raises UserError for an empty or very long one."""
        text = text.strip()
        if not text or len(text) > LONGEST_NOTE:
            raise UserError(f"a note has 1 to {LONGEST_NOTE} characters; this one has {len(text)}")
        write_whole(self.folder / f"steer-{time.time_ns()}.txt", text.encode())

    def pause(self) -> None:
        """Pause the search: no experiment begins until `go_on`."""
        write_whole(self.folder / "pause", b"")

    def go_on(self) -> None:
        """End a pause."""
        (self.folder / "pause").unlink(missing_ok=True)

    def stop(self) -> None:
        """End the search after the experiment that runs."""
        write_whole(self.folder / "stop", b"")

    @property
    def paused(self) -> bool:
        """Return whether a pause was requested."""
        return (self.folder / "pause").exists()

    def take_stop(self) -> bool:
        """Return whether a stop was requested, and clear the request."""
        try:
            (self.folder / "stop").unlink()
        except FileNotFoundError:
            return False
        return True

    def notes(self) -> list[tuple[Path, str]]:
        """Notes not yet recorded, oldest first; unlink each once it is."""
        found = sorted(self.folder.glob("steer-*.txt"))
        return [(path, path.read_text("utf-8", "replace")[:LONGEST_NOTE]) for path in found]

    @property
    def waiting(self) -> bool:
        """Return whether any request is waiting."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return False
        return any(n in ("pause", "stop") or n.startswith("steer-") for n in names)
