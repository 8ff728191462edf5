"""Requests of the user to a running search, and the loss of its running fits, as files in its
directory, so that any process can make the ones and read the others.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from asia.candidate import source_digest
from asia.errors import UserError
from asia.ledger.chain import Chain, in_use, ledger_of, write_whole
from asia.ledger.events import Noted
from asia.ledger.run import Run
from asia.ledger.view import SearchView

LONGEST_NOTE = 4000
_LONGEST_AUTHOR = 80
_TAG = re.compile(r"\w[\w.-]{0,29}")
_NOTED: TypeAdapter[Noted] = TypeAdapter(Noted)


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

    def record_noted(self, record: Callable[[Noted], None]) -> None:
        """Record the notes for people that are not yet recorded, oldest first; a file that is none
        is removed."""
        for path in sorted(self.folder.glob("noted-*.json")):
            try:
                noted = _NOTED.validate_json(path.read_bytes())
            except ValidationError:
                pass
            else:
                record(noted)
            path.unlink()

    @property
    def waiting(self) -> bool:
        """Return whether any request is waiting."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return False
        return any(n in ("pause", "stop") or n.startswith("steer-") for n in names)


# The training curves of the fits that run.


_LOSS_SECONDS = 0.5
_LOSS_POINTS = 100
_FITS_SHOWN = 16
FoldLosses = dict[int, list[tuple[float, float]]]
"""Steps and losses of a running fit, by the number of the fold."""
_CURVES: TypeAdapter[dict[str, FoldLosses]] = TypeAdapter(dict[str, FoldLosses])


class RunningLosses:
    """Writer of `control/losses.json`: training curves of the latest fits, by digest of the source
    and number of the fold. Another fit of the same source on the same fold replaces the curve."""

    def __init__(self, directory: Path) -> None:
        self._path = _losses_path(directory)
        self._path.unlink(missing_ok=True)
        self._lock = threading.Lock()
        self._written = -_LOSS_SECONDS
        self.curves: dict[str, FoldLosses] = {}

    def __call__(self, source: str, fold: int, step: float, loss: float) -> None:
        """Take the loss of a fit, from any thread."""
        with self._lock:
            digest = source_digest(source)
            folds = self.curves.setdefault(digest, {})
            curve = folds.setdefault(fold, [])
            if curve and step <= curve[-1][0]:
                curve.clear()
            curve.append((step, loss))
            if len(curve) > _LOSS_POINTS:
                del curve[1:-1:2]
            if len(self.curves) > _FITS_SHOWN:
                del self.curves[next(iter(self.curves))]
            if time.monotonic() - self._written >= _LOSS_SECONDS:
                self._written = time.monotonic()
                # A full disk is the ledger's to report.
                with contextlib.suppress(UserError):
                    write_whole(self._path, _CURVES.dump_json(self.curves), durable=False)


def running_losses(directory: Path, view: SearchView) -> dict[int, FoldLosses]:
    """Training curves (step, loss) of the experiments under way, by experiment and fold; empty for
    fits on other machines and for families that report no loss."""
    try:
        found = _CURVES.validate_json(_losses_path(directory).read_bytes())
    except (OSError, ValidationError):
        return {}
    known = [e for e in view.running if e.proposed.digest in found]
    return {e.number: dict(sorted(found[e.proposed.digest].items())) for e in known}


def _losses_path(directory: Path) -> Path:
    return directory / "control" / "losses.json"


def note_for_people(
    run: Run, author: str, text: str, experiment: int = 0, tags: Sequence[str] = (),
    removed: Sequence[str] = (),
) -> bool:  # fmt: skip
    """Note something on a run or on one of its experiments, or change its tags.

    Args:
        text: the note, or the reason of the tags
        experiment: its number; 0 for the run

    Returns:
        True where the ledger has it now, False where the process that writes the ledger records it
        at its next step.

    Raises:
        UserError: for a note without text or author, a word that is no tag, or an experiment that
            is not there
    """
    author, text = author.strip(), text.strip()
    if not 0 < len(text) <= LONGEST_NOTE:
        raise UserError(f"a note or a reason has 1 to {LONGEST_NOTE} characters, not {len(text)}")
    if not 0 < len(author) <= _LONGEST_AUTHOR:
        raise UserError(f"the author has 1 to {_LONGEST_AUTHOR} characters, not {len(author)}")
    for word in (*tags, *removed):
        if not _TAG.fullmatch(word):
            raise UserError(
                f"'{word}' is no tag: expected up to 30 letters, digits, '_', '-' and '.'"
            )
    if experiment:
        run.view.experiment(experiment)
    if missing := [word for word in removed if word not in run.view.tags(experiment)]:
        raise UserError(f"there is no tag '{missing[0]}' to remove")
    steering, ledger = Steering(run.directory), ledger_of(run.directory)
    noted = Noted(author, text, experiment, tuple(tags), tuple(removed))
    file = steering.folder / f"noted-{time.time_ns()}.json"
    write_whole(file, json.dumps(asdict(noted)).encode())
    if in_use(ledger):
        return False
    with Chain(ledger) as chain:
        steering.record_noted(chain.append)
    return True
