"""Looks at sealed tests, kept in the user's own folder by the digest of the test records."""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from asia._files import config_folder, read_private, sync_folder, write_private
from asia._text import one_line
from asia.errors import UserError
from asia.ledger.chain import LINE_LIMIT, open_ledger, read_lines
from asia.ledger.events import Started, Unsealing
from asia.ledger.view import SearchView


@dataclass(frozen=True)
class Look:
    """One opening of a sealed test."""

    folder: str
    """Folder of the run."""
    origin: str
    """Hex sha256 of the first line of the ledger, which copies of a run share."""
    time: str
    """ISO 8601, UTC."""

    @property
    def words(self) -> str:
        """Name of the folder and time."""
        day, _, clock = self.time.partition("T")
        return one_line(f"{Path(self.folder).name} on {day} at {clock[:5]} UTC", 200)


def record_look(test_digest: str, directory: Path) -> tuple[str, ...]:
    """Keep a look at a test by this run, now, and describe the looks before it that the user's
    folder keeps, and those in the ledgers of the other runs in the same folder, the first one
    first. An earlier look by this run, which its ledger lost, is one of them.

    Raises:
        UserError: a copy of the run in another folder has opened the test, or the user's folder
            cannot be written.
    """
    folder, now = str(directory.resolve()), datetime.now(UTC).isoformat(timespec="milliseconds")
    look = Look(folder, _origin(directory / "ledger.jsonl"), now)
    found = {one.origin: one for one in _looks_beside(directory, test_digest)}
    path = _kept_in(test_digest) / f"{look.origin}.json"
    for one in filter(None, map(_kept, path.parent.glob("*.json"))):
        found[one.origin] = one
    before = found.get(look.origin)
    if before is not None and before.folder != folder:
        raise UserError(
            f"{copy_words(directory.name, before)}: nothing was opened; "
            f"{one_line(before.folder, 300)} has the result"
        )
    if before is None:
        _keep(path, look)
    return tuple(one.words for one in sorted(found.values(), key=lambda one: one.time))


def _keep(path: Path, look: Look) -> None:
    new = path.with_name(f".{look.origin}.{os.getpid()}")
    try:
        write_private(new, json.dumps(asdict(look)).encode())
        try:
            os.link(new, path)  # fails where another process was faster
        finally:
            new.unlink()
        sync_folder(path.parent)
    except FileExistsError:
        raise UserError(
            f"a copy of this run is opening the test, or {path} is damaged: nothing was opened"
        ) from None
    except OSError as error:
        raise UserError(
            f"cannot write {path} ({error.strerror}): name a folder of yours with XDG_CONFIG_HOME"
        ) from None


def look_by_copy(directory: Path, view: SearchView) -> Look | None:
    """Return the look at the test by a copy of this run; None where its own ledger has the look."""
    test_digest = view.started.test_digest
    if test_digest is None or view.unsealing is not None:
        return None
    origin = _origin(directory / "ledger.jsonl")
    kept = _kept(_kept_in(test_digest) / f"{origin}.json")
    return kept or next(_looks_beside(directory, test_digest, origin), None)


def copy_words(run: str, look: Look) -> str:
    """Say that a copy of a run opened its test."""
    return one_line(f"the test of run '{run}' was opened by a copy, {look.words}", 400)


def _looks_beside(directory: Path, test_digest: str, origin: str | None = None) -> Iterator[Look]:
    """Yield the looks of the other runs in the same folder, of copies of `origin` alone where it is
    given. The first line of a ledger is read, and the rest where it names the same test."""
    own = directory.resolve() / "ledger.jsonl"
    for path in sorted(own.parent.parent.glob("*/ledger.jsonl")):
        with contextlib.suppress(UserError):
            if path == own or origin not in (None, other := _origin(path)):
                continue
            for line in read_lines(path):
                if isinstance(line.event, Started) and line.event.test_digest != test_digest:
                    break
                if isinstance(line.event, Unsealing):
                    yield Look(str(path.parent), other, line.time)


def _origin(ledger: Path) -> str:
    with open_ledger(ledger) as stream:
        return hashlib.sha256(stream.readline(LINE_LIMIT)).hexdigest()


def _kept_in(test_digest: str) -> Path:
    return config_folder() / "looks" / hashlib.sha256(test_digest.encode()).hexdigest()


def _kept(path: Path) -> Look | None:
    with contextlib.suppress(ValueError, TypeError):
        return Look(**json.loads(read_private(path) or b""))
    return None
