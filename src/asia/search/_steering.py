"""What a person says to a search that runs: files in its directory, so that any process can."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from asia.errors import UserError
from asia.ledger import write_whole

LONGEST_NOTE = 4000


@dataclass(frozen=True)
class Steering:
    """The `control` folder of a run directory."""

    directory: Path

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self.directory / "control"

    def steer(self, text: str) -> None:
        """Leave a note for the agent. Raises UserError for an empty or very long one."""
        text = text.strip()
        if not text or len(text) > LONGEST_NOTE:
            raise UserError(f"a note has 1 to {LONGEST_NOTE} characters; this one has {len(text)}")
        write_whole(self.folder / f"steer-{time.time_ns()}.txt", text.encode())

    def pause(self) -> None:
        """No experiment begins until `go_on`."""
        write_whole(self.folder / "pause", b"")

    def go_on(self) -> None:
        """End a pause."""
        (self.folder / "pause").unlink(missing_ok=True)

    def stop(self) -> None:
        """End the search after the experiment that runs."""
        write_whole(self.folder / "stop", b"")

    @property
    def paused(self) -> bool:
        """Whether a pause was asked for."""
        return (self.folder / "pause").exists()

    def take_stop(self) -> bool:
        """Whether a stop was asked for; it is then no more."""
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
        """Whether there is anything for the search."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return False
        return any(n in ("pause", "stop") or n.startswith("steer-") for n in names)
