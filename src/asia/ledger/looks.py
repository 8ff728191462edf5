"""Looks at sealed tests, kept in the user's own folder by the digest of the test records."""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from asia._files import config_folder, read_private, write_private
from asia._text import one_line
from asia.errors import UserError
from asia.ledger.chain import ledger_of, open_ledger, read_lines
from asia.ledger.events import Unsealing
from asia.ledger.view import SearchView

_LONGEST_LINE = 1 << 20


@dataclass(frozen=True)
class Look:
    """One opening of a sealed test."""

    run: str
    folder: str
    origin: str
    """Hex sha256 of the first line of the ledger, which copies of a run share."""
    time: str
    """ISO 8601, UTC."""

    @property
    def words(self) -> str:
        """Run and time."""
        day, _, clock = self.time.partition("T")
        return one_line(f"{self.run} on {day} at {clock[:5]} UTC", 200)


def look_of(directory: Path) -> Look:
    """Describe a look by this run, now."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    return Look(directory.name, str(directory.resolve()), _origin(directory), now)


def record_look(test_digest: str, look: Look) -> bool:
    """Keep a look; False where one by this run or a copy of it is kept already.

    Raises:
        UserError: the user's folder cannot be written.
    """
    path = _folder(test_digest) / f"{look.origin}.json"
    new = path.with_name(f".{look.origin}.{os.getpid()}")
    try:
        write_private(new, json.dumps(asdict(look)).encode())
        try:
            os.link(new, path)  # fails where another process was faster
        finally:
            new.unlink()
    except FileExistsError:
        return False
    except OSError as error:
        raise UserError(
            f"cannot write {path} ({error.strerror}): name a folder of yours with XDG_CONFIG_HOME"
        ) from None
    return True


def looks_at(test_digest: str, directory: Path) -> tuple[Look, ...]:
    """Return the looks at a test that the user's folder keeps, and those in the ledgers of the
    other runs beside `directory`, the first one first."""
    found = {look.origin: look for look in _looks_beside(directory, test_digest)}
    for path in _folder(test_digest).glob("*.json"):
        if (look := _kept(path)) is not None:
            found[look.origin] = look
    return tuple(sorted(found.values(), key=lambda look: look.time))


def look_by_copy(directory: Path, view: SearchView) -> Look | None:
    """Return the look at the test by a copy of this run; None where its own ledger has the look."""
    test_digest = view.started.test_digest
    if test_digest is None or view.unsealing is not None:
        return None
    origin = _origin(directory)
    kept = _kept(_folder(test_digest) / f"{origin}.json")
    return kept or next(_looks_beside(directory, test_digest, origin), None)


def copy_words(run: str, look: Look) -> str:
    """Say that a copy of a run opened its test."""
    return one_line(
        f"the test of run '{run}' was opened by a copy, {look.words}, {look.folder}", 400
    )


def seal_words(directory: Path, view: SearchView) -> str | None:
    """Describe a look at the test that its own ledger does not have, or that is not the first one;
    None for a first look, or none."""
    if (copy := look_by_copy(directory, view)) is not None:
        return copy_words(view.started.run, copy)
    return None if view.unsealing is None else later_words(view.unsealing.opened_before)


def later_words(before: Sequence[str]) -> str | None:
    """Give the number of a look at test records, and the looks before; None for the first one."""
    if not before:
        return None
    return f"look {len(before) + 1} at these test records, after {one_line('; '.join(before), 600)}"


def _looks_beside(directory: Path, test_digest: str, origin: str | None = None) -> Iterator[Look]:
    """Yield the looks of the other runs in the same folder, of copies of `origin` alone where it is
    given."""
    here = directory.resolve()
    for folder in sorted(path.parent for path in here.parent.glob("*/ledger.jsonl")):
        if folder == here:
            continue
        with contextlib.suppress(UserError):
            own = _origin(folder)
            if origin not in (None, own):
                continue
            for line in read_lines(ledger_of(folder)):
                event = line.event
                if isinstance(event, Unsealing) and event.test_digest == test_digest:
                    yield Look(folder.name, str(folder), own, line.time)


def _origin(directory: Path) -> str:
    with open_ledger(ledger_of(directory)) as stream:
        return hashlib.sha256(stream.readline(_LONGEST_LINE)).hexdigest()


def _folder(test_digest: str) -> Path:
    return config_folder() / "looks" / hashlib.sha256(test_digest.encode()).hexdigest()


def _kept(path: Path) -> Look | None:
    with contextlib.suppress(ValueError, TypeError):
        return Look(**json.loads(read_private(path) or b""))
    return None
