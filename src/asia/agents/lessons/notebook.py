"""Lessons as files: the shipped set, and those that a person keeps."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from asia._files import read_file
from asia.agents._lesson import LARGEST_GAIN, Lesson, merge
from asia.errors import UserError
from asia.ledger import write_whole

FOLDER_VARIABLE = "ASIA_LESSONS"
_FILE = "lessons.json"
_Gain = Annotated[float, Field(ge=-LARGEST_GAIN, le=LARGEST_GAIN)]
_Row = tuple[str, list[str], list[tuple[str, str, _Gain | None]]]
_ROWS: TypeAdapter[list[_Row]] = TypeAdapter(list[_Row])


def encode_lessons(lessons: Sequence[Lesson]) -> bytes:
    """JSON: one line a search, its digest, the traits of its problem, and family, move and gain of
    each lesson. The same lessons give the same bytes."""
    runs: dict[tuple[str, frozenset[str]], list[Any]] = {}
    for one in lessons:
        gain = None if one.gain is None else round(one.gain, 4)
        runs.setdefault((one.run, one.kind), []).append((one.family, one.move, gain))
    lines = [json.dumps([run, sorted(kind), rows]) for (run, kind), rows in runs.items()]
    return ("[\n" + ",\n".join(lines) + "\n]\n").encode()


def decode_lessons(data: bytes, where: str) -> tuple[Lesson, ...]:
    """The lessons of `encode_lessons`. Raises UserError that names `where` for anything else."""
    try:
        rows = _ROWS.validate_json(data, strict=False)
    except ValueError:
        raise UserError(
            f"{where} holds no lessons: expected a file that asia lessons --export wrote"
        ) from None
    return tuple(
        Lesson(run, frozenset(kind), family, move, gain)
        for run, kind, lessons in rows
        for family, move, gain in lessons
    )


def shipped_lessons() -> tuple[Lesson, ...]:
    """Those that come with the package, from synthetic systems and public benchmarks."""
    data = files("asia.agents.lessons").joinpath("shipped.json").read_bytes()
    return decode_lessons(data, "shipped.json")


def notebook_path() -> Path:
    """Where a person's lessons are: $ASIA_LESSONS, else asia/lessons.json in $XDG_DATA_HOME or
    ~/.local/share."""
    named = os.environ.get(FOLDER_VARIABLE, "")
    if named:
        return Path(named).expanduser() / _FILE
    data = os.environ.get("XDG_DATA_HOME", "")
    base = Path(data) if Path(data).is_absolute() else Path.home() / ".local" / "share"
    return base / "asia" / _FILE


def kept_lessons() -> tuple[Lesson, ...]:
    """A person's lessons; () where none were kept. Raises UserError for a file that is damaged."""
    path = notebook_path()
    if not path.exists():
        return ()
    remedy = "mend it, or remove it with asia lessons --forget"
    return decode_lessons(read_file(path, remedy), str(path))


def keep_lessons(new: Sequence[Lesson]) -> tuple[Lesson, ...]:
    """Add to a person's lessons; all of them."""
    lessons = merge(kept_lessons(), new)
    write_whole(notebook_path(), encode_lessons(lessons))
    return lessons


def forget_lessons() -> bool:
    """Remove a person's lessons; whether there were any."""
    path = notebook_path()
    found = path.exists()
    path.unlink(missing_ok=True)
    return found
