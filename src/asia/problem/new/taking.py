"""The records of a new problem: files that stay as they are, or clean copies of them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from asia._files import read_file
from asia.data._trajectory import Trajectory
from asia.data.intake.formats.table import FORMATS
from asia.data.intake.formats.text import Text
from asia.data.intake.records import Intake, take_in
from asia.data.intake.sheet import Wanted
from asia.data.sources.csv import read_csv
from asia.data.sources.source import unique_names
from asia.errors import UserError

_HASHED = 64_000_000


@dataclass(frozen=True)
class Taken:
    """The records of a problem. plain: whether the files read as they are, so that they stay where
    they are. units: by channel, where the files give them. notes: what was found and done.
    progress: told how far a long writing is."""

    train: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    sampling_time: float
    plain: bool
    units: Mapping[str, str]
    notes: tuple[str, ...]
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)


def take(
    train: Sequence[Path],
    test: Sequence[Path],
    wanted: Wanted,
    sampling_time: float | None,
    least: tuple[int, int],
) -> Taken:
    """least: samples that a piece of a training record and of a test record must have to count.
    Raises UserError."""
    if sampling_time is not None and not _is_special(wanted):
        try:
            plain = _plain((*train, *test), wanted, sampling_time)
        except UserError:
            plain = None
        if plain is not None:
            cut = len(train)
            return Taken(plain[:cut], plain[cut:], sampling_time, True, {}, ())
    found = take_in(train, wanted, "train", sampling_time, least[0])
    step = found.records[0].sampling_time
    tested = take_in(test, wanted, "test", step, least[1]) if test else Intake((), {}, ())
    notes = (*found.notes, *tested.notes)
    records = _renamed((*found.records, *tested.records))
    units = {**tested.units, **found.units}
    cut = len(found.records)
    plain = not notes and not units and not _is_special(wanted)
    plain = plain and _reads_plainly((*train, *test), wanted, step, records)
    return Taken(records[:cut], records[cut:], step, plain, units, notes, wanted.progress)


def origins(paths: Sequence[Path]) -> list[str]:
    """Where clean copies come from, a line a file."""
    return [f"{path}{_hash(path)}" for path in paths]


def _hash(path: Path) -> str:
    if not path.is_file() or path.stat().st_size > _HASHED:
        return ""
    return f", sha256 {hashlib.sha256(read_file(path, 'name a file')).hexdigest()[:16]}"


def _is_special(wanted: Wanted) -> bool:
    return bool(wanted.experiment or wanted.columns or wanted.time_unit)


def _plain(paths: Sequence[Path], wanted: Wanted, step: float) -> tuple[Trajectory, ...] | None:
    """The records of text files that need no change; None where their stamps say otherwise."""
    if any(path.suffix.lower() in f.suffixes for path in paths for f in FORMATS if f is not Text):
        return None
    found = [read_csv(path, wanted.inputs, wanted.outputs, step) for path in paths]
    if wanted.time != "none" and any(one.warnings for one in found):
        return None
    if any(one.trajectory.missing is not None for one in found):
        return None
    return tuple(one.trajectory for one in found)


def _reads_plainly(
    paths: Sequence[Path], wanted: Wanted, step: float, records: Sequence[Trajectory]
) -> bool:
    try:
        found = _plain(paths, wanted, step)
    except UserError:
        return False
    return (
        found is not None
        and len(found) == len(records)
        and all(
            np.array_equal(a.u, b.u) and np.array_equal(a.measured_y, b.measured_y, equal_nan=True)
            for a, b in zip(found, records, strict=True)
        )
    )


def _renamed(records: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """With names that are file names, all different."""
    bare = [re.sub(r"[^\w.+-]+", "_", t.name).strip("._") or "record" for t in records]
    names = unique_names(bare)
    return tuple(replace(t, name=n) for t, n in zip(records, names, strict=True))
